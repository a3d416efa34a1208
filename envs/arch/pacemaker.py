"""PM: a pacemaker in mode AOO, which paces whatever the heart does.

    pacemaker()                                         # 10 s; feature LRL

Feature, a function of time or a number: `LRL`, the lower rate limit, 50 to 90 paces a minute.
Signals, every 0.01 s: `paces`, how many there were, and `LRL`.

Source: the Stateflow chart of the public Simulink model Model1_Scenario1_Correct.slx, step 1 ms.
CHARGE ends after `60000 / LRL - 2` ms, compared at each ms with the present limit; PACE counts one
and ends after 2 ms. That the original rounds the period by its data types is taken to be harmless.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from envs.arch.stepped import Features, Stepped, real, value, whole

DT = 0.01
TICK = 0.001
TICKS = 10
PACE_TICKS = 2
NOMINAL = {"LRL": 60.0}


class State(NamedTuple):
    """The mode (pacing or charging), ms since its start, and the count of paces."""

    pacing: Bool[Array, ""]
    since: Int[Array, ""]
    paces: Int[Array, ""]


def initial(features: Features) -> State:
    """Return the state at time 0: charging, with no pace yet."""
    return State(jnp.array(False), jnp.int32(0), jnp.int32(0))


def advance(k: Int[Array, ""], state: State, features: Features) -> State:
    """Run ten ticks of the chart."""

    def tick(state: State, j: Int[Array, ""]) -> tuple[State, None]:
        limit = value(features["LRL"], (k * TICKS + j + 1).astype(real()) * TICK)
        since = state.since + 1
        charged = ~state.pacing & (since >= 60_000 / limit - PACE_TICKS)
        ended = charged | (state.pacing & (since >= PACE_TICKS))
        return State(state.pacing ^ ended, jnp.where(ended, 0, since), state.paces + charged), None

    return jax.lax.scan(tick, state, jnp.arange(TICKS))[0]


def signals(k: Int[Array, ""], state: State, features: Features) -> dict[str, Float[Array, ""]]:
    """Return the signals of the requirement, and the input."""
    return {
        "paces": state.paces.astype(real()),
        "LRL": value(features["LRL"], k.astype(real()) * DT),
    }


def pacemaker(duration: float = 10.0) -> Stepped:
    """Make the model a system.

    - `duration`: simulated seconds, a multiple of 0.01.
    """
    return Stepped(initial, advance, signals, DT, whole(duration, DT, "duration"), NOMINAL)
