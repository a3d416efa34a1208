"""The gradient of a simulation with contacts, compared with differences over finite steps.

    python -m benchmarks.contact_gradients

A ball is thrown over, under or against a rail (`envs/ball.py`). The derivative of where it is in
the end with respect to speed, lift and height of the throw, from MJX in float64 by forward mode,
is compared with central differences over steps of 1e-6 to 1e-1 of each feature's range. Beside it
the same for the cart-pole, which has no contacts. Prints the tables of docs/mujoco.md.
"""

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from envs import ball, cartpole, mujoco_cartpole

ROWS = 128
STEPS = (1e-6, 1e-4, 1e-3, 1e-2, 1e-1)


def thrown(unit: jax.Array) -> jax.Array:
    """Place in m after 1.5 s of a ball thrown as `unit`, `[3]` in the unit cube, says."""
    low, high = jnp.array([2.0, 1.0, 0.2]), jnp.array([5.0, 5.0, 1.0])
    values = low + unit * (high - low)
    system = ball.ball(features=["speed", "lift", "height"], duration=1.5, backend="mjx")
    features = dict(zip(("speed", "lift", "height"), values, strict=True))
    return system(features)["x"][-1]


def balanced(unit: jax.Array) -> jax.Array:
    """Angle of the pole after 1.5 s, for a throw of the pole that `unit` says."""
    low, high = jnp.array([-0.5, -0.1, 0.05]), jnp.array([0.5, 0.1, 0.5])
    values = low + unit * (high - low)
    features = ("x0", "theta0", "masspole")
    system = mujoco_cartpole.cartpole(
        cartpole.linear(), features=features, duration=1.5, backend="mjx"
    )
    return system(dict(zip(features, values, strict=True)))["theta"][-1]


def compare(name: str, simulate: Callable[[jax.Array], jax.Array]) -> None:
    """Print one table."""
    points = jax.random.uniform(jax.random.key(0), (ROWS, 3), minval=0.1, maxval=0.9)
    run = jax.jit(jax.vmap(simulate))
    started = time.perf_counter()
    gradient = np.asarray(jax.jit(jax.vmap(jax.jacfwd(simulate)))(points))
    print(f"{name}: {ROWS} points, 3 features; {time.perf_counter() - started:.0f} s")
    print("step  same sign  within 1 %  within 10 %  off by more than 10x  median |gradient|")
    for step in STEPS:
        difference = np.stack(
            [
                np.asarray(run(points.at[:, i].add(step)) - run(points.at[:, i].add(-step)))
                / (2 * step)
                for i in range(3)
            ],
            axis=-1,
        )
        share = np.abs(gradient - difference) / np.abs(difference)
        ratio = np.abs(gradient) / np.abs(difference)
        print(
            f"{step:.0e}  {np.mean(np.sign(gradient) == np.sign(difference)):.3f}  "
            f"{np.mean(share < 0.01):.3f}  {np.mean(share < 0.1):.3f}  "
            f"{np.mean((ratio > 10) | (ratio < 0.1)):.3f}  {np.median(np.abs(difference)):.3g}"
        )


def main() -> None:
    """Print both tables."""
    with jax.enable_x64():
        compare("cart-pole", balanced)
        compare("ball", thrown)


if __name__ == "__main__":
    main()
