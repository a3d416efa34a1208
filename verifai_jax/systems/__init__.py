"""Systems under test: anything that turns features and a random key into a trace."""

from verifai_jax.systems.blackbox import BlackBox as BlackBox
from verifai_jax.systems.blackbox import blackbox as blackbox
from verifai_jax.systems.ode import Ode as Ode
from verifai_jax.systems.ode import ode as ode
from verifai_jax.systems.trig import sin_cos as sin_cos
