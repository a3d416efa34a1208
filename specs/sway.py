"""A tower that sways, and pushes of limited force: those that answer the sway bring it down.

The tower is a damped oscillator of 2 s, its displacement in units of that under the greatest push.
Pushes that are planned in advance, nine pieces of 4.4 s, move it by less than 9 units, whatever
they are: all corners of their space have been tried, and the system is linear. A small network with
as many parameters, which sees displacement and speed, pushes in step with it.
"""

import jax
import jax.numpy as jnp

import verifai_jax as vj

DT = 0.05
"""Step in seconds."""
STEPS = 800
FREQUENCY = jnp.pi
"""Of the tower, in radians a second."""
DAMPING = 0.02
"""Share of the critical damping."""


def sway(push):
    """Simulate 40 s; `push(time, x, v)` from -1 to 1."""

    def step(state, number):
        x, v = state
        force = push(number * DT, x, v)
        v = v + DT * (FREQUENCY**2 * (force - x) - 2 * DAMPING * FREQUENCY * v)
        x = x + DT * v
        return (x, v), x

    _, x = jax.lax.scan(step, (jnp.zeros(()), jnp.zeros(())), jnp.arange(STEPS))
    return vj.Trace({"x": x}, dt=DT)


def reacting(features, key):
    """Pushes that see the tower."""
    push = features["push"]
    return sway(lambda time, x, v: push(x=x, v=v))


def planned(features, key):
    """Pushes that were planned."""
    push = features["push"].over(DT * STEPS)
    return sway(lambda time, x, v: push(time))


NETWORK = vj.Reactive({"x": (-10, 10), "v": (-30, 30)}, hidden=2, bounds=(-1, 1))
"""Nine parameters."""
PIECES = vj.Signal(vj.Box(-1, 1), knots=9, hold="constant")
"""Nine parameters too."""
SPEC = "always abs(x) < 14"

reactive = vj.Problem(
    "reactive", {"push": NETWORK}, reacting, SPEC, description="a tower, and pushes that answer it"
)
open_loop = vj.Problem(
    "open_loop", {"push": PIECES}, planned, SPEC, description="a tower, and pushes planned before"
)
