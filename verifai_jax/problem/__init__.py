"""A falsification problem: its feature space, its system, its formulas and their priority."""

from verifai_jax.problem.behaviour import Behaviour as Behaviour
from verifai_jax.problem.guide import Guide as Guide
from verifai_jax.problem.problem import Problem as Problem
from verifai_jax.problem.problem import ProblemError as ProblemError
from verifai_jax.problem.rulebook import Rulebook as Rulebook
