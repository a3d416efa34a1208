"""Systems written as equations of motion."""

from verifai_jax.systems.ode._ode import ode as ode
from verifai_jax.systems.ode.closed_loop import Ode as Ode
from verifai_jax.systems.ode.trigonometry import sin_cos as sin_cos
