"""Systems under test: anything that turns features and a random key into a trace."""

from verifai_jax.systems.blackbox import BlackBox as BlackBox
from verifai_jax.systems.blackbox import blackbox as blackbox
from verifai_jax.systems.blackbox import stacked as stacked
from verifai_jax.systems.brax import Brax as Brax
from verifai_jax.systems.brax import brax as brax
from verifai_jax.systems.gymnasium import gymnasium as gymnasium
from verifai_jax.systems.gymnax import gymnax as gymnax
from verifai_jax.systems.mujoco_bindings import scaled as scaled
from verifai_jax.systems.mujoco_system import MuJoCo as MuJoCo
from verifai_jax.systems.mujoco_system import mjx as mjx
from verifai_jax.systems.mujoco_system import mujoco as mujoco
from verifai_jax.systems.mujoco_system import native as native
from verifai_jax.systems.ode import Ode as Ode
from verifai_jax.systems.ode import ode as ode
from verifai_jax.systems.remote import remote as remote
from verifai_jax.systems.trig import sin_cos as sin_cos
