"""Faults of sensors and actuators, as features that are searched, shrunk and given a probability.

faulty = problem.with_faults(
    vj.faults.Dropout("gyro", onset=vj.Box(0, 3), duration=vj.Box(0, 0.5)),
    vj.faults.Bias("observation[2]", offset=vj.Box(-0.1, 0.1)),
)
vj.falsify(faulty)
"""

from typing import TYPE_CHECKING

from verifai_jax.core.display.lazy import attach

if TYPE_CHECKING:
    from verifai_jax.addons.faults.failure_table.sheet import Scale as Scale
    from verifai_jax.addons.faults.fault import AtMost as AtMost
    from verifai_jax.addons.faults.fault import Fault as Fault
    from verifai_jax.addons.faults.injection import on_host as on_host
    from verifai_jax.addons.faults.kinds import Backlash as Backlash
    from verifai_jax.addons.faults.kinds import Bias as Bias
    from verifai_jax.addons.faults.kinds import ClockJitter as ClockJitter
    from verifai_jax.addons.faults.kinds import DeadBand as DeadBand
    from verifai_jax.addons.faults.kinds import Delay as Delay
    from verifai_jax.addons.faults.kinds import Drift as Drift
    from verifai_jax.addons.faults.kinds import Dropout as Dropout
    from verifai_jax.addons.faults.kinds import Freeze as Freeze
    from verifai_jax.addons.faults.kinds import Gain as Gain
    from verifai_jax.addons.faults.kinds import HeldAction as HeldAction
    from verifai_jax.addons.faults.kinds import LossOfAuthority as LossOfAuthority
    from verifai_jax.addons.faults.kinds import Noise as Noise
    from verifai_jax.addons.faults.kinds import PacketLoss as PacketLoss
    from verifai_jax.addons.faults.kinds import Quantisation as Quantisation
    from verifai_jax.addons.faults.kinds import RateLimit as RateLimit
    from verifai_jax.addons.faults.kinds import Saturation as Saturation
    from verifai_jax.addons.faults.kinds import SignFlip as SignFlip
    from verifai_jax.addons.faults.kinds import Spikes as Spikes
    from verifai_jax.addons.faults.kinds import Stuck as Stuck
    from verifai_jax.addons.faults.kinds import WrongChannel as WrongChannel
__getattr__, __dir__, __all__ = attach(__name__)
