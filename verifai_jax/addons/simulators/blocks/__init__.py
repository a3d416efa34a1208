"""Building blocks of models for `vj.ode`: tables, delays, modes, switches, adaptive integrators.

torque = blocks.LookupTable([800, 1600, 2400], [90.0, 130.0, 110.0])
line = blocks.delay_line(14.7, longest=0.8, period=0.01)
vj.ode(..., switches=[blocks.Switch(guard, reset)], method=blocks.adaptive("Kvaerno5"))
"""

from verifai_jax.addons.simulators.blocks.adaptive import adaptive as adaptive
from verifai_jax.addons.simulators.blocks.lookup_table import LookupTable as LookupTable
from verifai_jax.systems.ode.delay_line import DelayLine as DelayLine
from verifai_jax.systems.ode.delay_line import delay_line as delay_line
from verifai_jax.systems.ode.switching import Switch as Switch
from verifai_jax.systems.ode.switching import hysteresis as hysteresis
from verifai_jax.systems.ode.switching import latch as latch

__all__ = ["DelayLine", "LookupTable", "Switch", "adaptive", "delay_line", "hysteresis", "latch"]


def __dir__() -> list[str]:
    return list(__all__)
