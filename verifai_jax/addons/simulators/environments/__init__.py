"""Environments of Brax, gymnax, Gymnasium and MuJoCo Playground as systems."""

from verifai_jax.addons.simulators.environments._brax import Brax as Brax
from verifai_jax.addons.simulators.environments._brax import brax as brax
from verifai_jax.addons.simulators.environments._gymnasium import EpisodeFunction as EpisodeFunction
from verifai_jax.addons.simulators.environments._gymnasium import gymnasium as gymnasium
from verifai_jax.addons.simulators.environments._gymnax import Gymnax as Gymnax
from verifai_jax.addons.simulators.environments._gymnax import gymnax as gymnax
from verifai_jax.addons.simulators.environments._playground import playground as playground
