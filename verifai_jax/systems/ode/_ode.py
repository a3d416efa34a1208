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
      state; `time` in seconds; `control` is None without a controller. A `Signal` with constant
      pieces keeps its value during a step; a piece that begins during a step takes effect with the
      next.
    - `initial(features, key) -> state`: a pytree of real numbers, converted to one float dtype.
    - `controller(time, state, features) -> control`: returns any pytree.
    - `dt`: step and sampling period in seconds; the trace has a sample at 0 and after each step.
    - `duration`: duration in seconds, a multiple of `dt`; alternatively the number of `steps`.
    - `method`: `"rk4"`, `"euler"`, or `"semi_implicit_euler"`, whose state is a tuple `(positions,
      velocities)`; or an integrator, such as those made by `vj.blocks.adaptive`.
    - `control_period`: seconds between two calls of the controller, a multiple of `dt`, by default
      `dt`; its output is held in between.
    - `controller_memory`: the initial memory of a controller with memory (an integrator, a filter).
      It is then called as `controller(time, state, memory, features)` and returns `(control,
      memory)`.
    - `signals(time, state, control, features) -> dict`: returns a scalar or vector for each name,
      at each sample; `control` is the one applied from this sample on. By default the signals have
      the names of the state and of the control; a control without names is called `control`.
    - `terminate(state, features) -> bool`: ends the simulation. The first sample at which it is
      true is the last valid one; the state is frozen from there on.
    - `unroll`: steps in one iteration of the compiled loop; affects speed only.
    - `exact_step`: True if the method and its step define the plant, as in an environment that is
      published as a difference equation. A counterexample is then confirmed only in double
      precision and under rounding. False for a plant that moves continuously, which a step
      approximates: counterexamples are also replayed at a third and a quarter of it.
    - `update(time, state, features) -> state`: makes instantaneous changes at each sample except
      the first, before the controller runs: a delay line, a latch, a counter. The derivative of
      such a part is 0.
    - `switches`: jumps of the state, such as an impact or a change of the mode, at instants located
      within the step; see `vj.blocks.Switch`.
    **Returns:** an `Ode`, whose traces have the status `NONFINITE` if the state becomes so.
    **Raises:** `ValueError` for inconsistent times, an unknown method, and functions with other
    arguments; when the system is traced, for functions whose results do not fit together.
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
