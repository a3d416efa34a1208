"""A system from equations of motion: a plant, a controller in the loop, a fixed step.

    ode(fall, start, dt=0.01, duration=2.0)                               # a plant alone
    ode(cart, start, controller=lqr, control_period=0.04, dt=0.02, duration=4.0)
    ode(cart, start, controller=pid, controller_memory=0.0, dt=0.02, steps=200, terminate=fell)

The result is a pure function `(features, key) -> Trace` that can be vmapped and differentiated,
forward and reverse.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from jaxtyping import PyTree

from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.core.user_code.user_errors import check_called_with
from verifai_jax.systems.clock import count_periods
from verifai_jax.systems.ode.closed_loop import Ode
from verifai_jax.systems.ode.integrators import Integrator, integrator
from verifai_jax.systems.ode.switching import Switch


@suggests_options
def ode(
    dynamics: Callable[..., Any],
    initial: Callable[..., Any],
    *,
    controller: Callable[..., Any] | None = None,
    dt: float,
    duration: float | None = None,
    steps: int | None = None,
    method: str | Integrator = "rk4",
    control_period: float | None = None,
    controller_memory: PyTree = None,
    signals: Callable[..., Mapping[str, Any]] | None = None,
    terminate: Callable[..., Any] | None = None,
    unroll: int = 1,
    exact_step: bool = False,
    update: Callable[..., Any] | None = None,
    switches: Sequence[Switch] = (),
) -> Ode:
    """Make a system `(features, key) -> Trace` from equations of motion, with a fixed step.

    **Arguments:**
    - `dynamics(time, state, control, features) -> derivative`: d state / d time, in the form of the
      state; `time` in seconds; `control` is None without a controller. A `Signal` that is held
      keeps its value within a step; a piece that begins within one begins with the next.
    - `initial(features, key) -> state`: any pytree of real numbers, all made one float dtype.
    - `controller(time, state, features) -> control`: any pytree.
    - `dt`: step and sampling period in seconds; the trace has a sample at 0 and after each step.
    - `duration`: in seconds, a multiple of `dt`; or the number of `steps`.
    - `method`: `"rk4"`, `"euler"`, or `"semi_implicit_euler"`, whose state is a tuple
      `(positions, velocities)`; or an integrator, as `vj.blocks.adaptive` makes them.
    - `control_period`: seconds between two runs of the controller, a multiple of `dt`; its output
      is held in between. `dt` when left out.
    - `controller_memory`: the memory at time 0 of a controller that has one (an integrator, a
      filter). It is then called `controller(time, state, memory, features)` and returns
      `(control, memory)`.
    - `signals(time, state, control, features) -> dict`: a scalar or vector for each name, at each
      sample; `control` is the one applied from this sample on. When left out: the state's own
      names, those of the control, and `control` for a control without names.
    - `terminate(state, features) -> bool`: ends the simulation. The first sample at which it is
      true is the last valid one; the state stays frozen from there on.
    - `unroll`: steps in one iteration of the compiled loop; changes speed only.
    - `exact_step`: True where the method and its step define the plant, as in an environment that
      is published as a difference equation. A counterexample is then confirmed in double precision
      and under rounding alone. False for a plant that moves continuously, of which a step is an
      approximation: counterexamples are also replayed at a half and a quarter of it.
    - `update(time, state, features) -> state`: what changes at once at each sample but the first,
      before the controller runs: a delay line, a latch, a counter. The derivative of such a part
      is 0.
    - `switches`: jumps of the state, such as an impact or a change of the mode, at instants found
      within the step; see `vj.blocks.Switch`.
    **Returns:** an `Ode`. The status of its trace is `NONFINITE` if the state became NaN or
    infinite.
    **Raises:** `ValueError` for times that do not fit, an unknown method, and functions of other
    arguments; once the system is traced, for functions whose results do not fit together.
    """
    if not (isinstance(dt, int | float) and math.isfinite(dt) and dt > 0):
        raise ValueError(f"dt must be a positive number of seconds; got {dt!r}")
    if (duration is None) == (steps is None):
        raise ValueError(f"give either duration or steps; got (duration={duration}, steps={steps})")
    if steps is None:
        assert duration is not None
        steps = count_periods(duration, dt, "duration")
    check_count("steps", steps)
    integrator(method)
    if controller is None and (control_period is not None or controller_memory is not None):
        raise ValueError("control_period and controller_memory need a controller; got none")
    check_count("unroll", unroll)
    if isinstance(switches, Switch):
        raise ValueError("switches must be a list of vj.blocks.Switch; got one: write [switch]")
    for switch in switches:
        if not isinstance(switch, Switch):
            raise ValueError(f"switches must be a list of vj.blocks.Switch; got {switch!r}")
    memory = () if controller_memory is None else ("memory",)
    check_called_with("dynamics", dynamics, ("time", "state", "control", "features"))
    check_called_with("initial", initial, ("features", "key"))
    check_called_with("controller", controller, ("time", "state", *memory, "features"))
    check_called_with("signals", signals, ("time", "state", "control", "features"))
    check_called_with("terminate", terminate, ("state", "features"))
    check_called_with("update", update, ("time", "state", "features"))
    if callable(method):
        check_called_with("method", method, ("derivative", "time", "state", "dt"))
    return Ode(
        dynamics=dynamics,
        initial=initial,
        controller=controller,
        controller_memory=controller_memory,
        dt=float(dt),
        steps=steps,
        steps_per_control=(
            1 if control_period is None else count_periods(control_period, dt, "control_period")
        ),
        method=method,
        signals=signals,
        terminate=terminate,
        unroll=unroll,
        exact_step=exact_step,
        update=update,
        switches=tuple(switches),
    )
