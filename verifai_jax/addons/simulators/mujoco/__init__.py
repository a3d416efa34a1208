"""MuJoCo models as systems, in MJX or in C."""

from verifai_jax.addons.simulators.mujoco.bindings import Scaled as Scaled
from verifai_jax.addons.simulators.mujoco.system import MuJoCo as MuJoCo
from verifai_jax.addons.simulators.mujoco.system import mjx as mjx
from verifai_jax.addons.simulators.mujoco.system import mujoco as mujoco
from verifai_jax.addons.simulators.mujoco.system import native as native
