"""Five failing systems whose point of no return is known: in closed form, or by induction."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.integrate import quad

import verifai_jax as vj


class Known(NamedTuple):
    """A problem, features of a failing simulation, the bounds of actions, and the known instant."""

    problem: vj.Problem
    features: dict[str, float]
    actions: tuple[Any, Any]
    instant: float


def loop(dynamics, initial, control, signals, dt, duration, **options):
    return vj.ode(
        dynamics, initial=lambda f, key: initial(f), controller=lambda t, s, f: control,
        signals=lambda t, s, u, f: signals(s), dt=dt, duration=duration, **options,
    )  # fmt: skip


BRAKE = 4.0
WALL = vj.Problem(
    "wall", {"v0": vj.Box(4, 8)},
    loop(
        lambda t, s, u, f: jnp.stack([s[1], u]), lambda f: jnp.stack([0.0 * f["v0"], f["v0"]]),
        jnp.zeros(()), lambda s: {"x": s[0]}, 0.02, 3.0,
    ),
    "always x <= 10",
)  # fmt: skip


def wall(rng):
    """A double integrator before a wall: the distance to stop is `v^2 / 2a`."""
    v = rng.uniform(4, 8)
    return Known(WALL, {"v0": v}, (-BRAKE, BRAKE), (10 - v**2 / (2 * BRAKE)) / v)


def car_problem():
    def signals(t, s, u, f):
        return {"gap": jnp.sqrt((s[0] - 15) ** 2 + s[1] ** 2 + 1e-12) - f["r"], "y": s[1]}

    def dynamics(t, s, u, f):
        return f["v"] * jnp.stack([jnp.cos(s[2]), jnp.sin(s[2]), u])

    system = vj.ode(
        dynamics, initial=lambda f, key: jnp.zeros(3) * f["v"],
        controller=lambda t, s, f: jnp.zeros(()), signals=signals, dt=0.02, duration=3.0,
    )  # fmt: skip
    return vj.Problem("car", {"v": vj.Box(6, 12), "r": vj.Box(1, 3)}, system, "always gap >= 0")


CAR = car_problem()
CURVATURE = 0.2


def car(rng):
    """A car of least turning radius R before a disc of radius r: it needs `sqrt(r^2 + 2 R r)`."""
    v, r = rng.uniform(6, 12), rng.uniform(1, 3)
    need = np.sqrt(r**2 + 2 * r / CURVATURE)
    return Known(CAR, {"v": v, "r": r}, (-CURVATURE, CURVATURE), (15 - need) / v)


G, TORQUE, LIMIT = 4.0, 1.5, 0.3
PENDULUM = vj.Problem(
    "pendulum", {"angle": vj.Box(0.02, 0.1), "speed": vj.Box(0.1, 0.4)},
    loop(
        lambda t, s, u, f: jnp.stack([s[1], G * jnp.sin(s[0]) + u]),
        lambda f: jnp.stack([f["angle"], f["speed"]]),
        jnp.zeros(()), lambda s: {"angle": s[0]}, 0.015, 1.8,
    ),
    f"always abs(angle) <= {LIMIT}",
)  # fmt: skip


def pendulum(rng):
    """A pendulum that falls from upright, with a motor that hardly holds it at the limit.

    Falling freely, `w^2 / 2 + g cos(a)` stays `E`; with full torque `w^2 / 2 + g cos(a) + u a`
    stays, and must be too small to reach the limit.
    """
    angle, speed = rng.uniform(0.02, 0.1), rng.uniform(0.1, 0.4)
    energy = speed**2 / 2 + G * np.cos(angle)
    last = (G * np.cos(LIMIT) + TORQUE * LIMIT - energy) / TORQUE
    time = quad(lambda a: 1 / np.sqrt(2 * (energy - G * np.cos(a))), angle, last)[0]
    return Known(PENDULUM, {"angle": angle, "speed": speed}, (-TORQUE, TORQUE), time)


LAG, VALVE = 0.5, 3.0
TANK = vj.Problem(
    "tank", {"h0": vj.Box(0.5, 2), "inflow": vj.Box(0.8, 1.6)},
    vj.ode(
        lambda t, s, u, f: jnp.stack([f["inflow"] - s[1], (u - s[1]) / LAG]),
        initial=lambda f, key: jnp.stack([f["h0"], 0.0 * f["h0"]]),
        controller=lambda t, s, f: jnp.zeros(()),
        signals=lambda t, s, u, f: {"h": s[0]}, dt=0.03, duration=4.5,
    ),
    {"overflow": "always h <= 4", "dry": "always h >= 0.2"},
)  # fmt: skip


def tank(rng):
    """A tank whose valve follows its command with a lag: it rises until outflow equals inflow."""
    level, inflow = rng.uniform(0.5, 2), rng.uniform(0.8, 1.6)
    until = -LAG * np.log(1 - inflow / VALVE)
    rise = inflow * until - VALVE * until + LAG * inflow
    return Known(TANK, {"h0": level, "inflow": inflow}, (0.0, VALVE), (4 - rise - level) / inflow)


MOVES = np.array([[0, 0], [0, 1], [0, -1], [-1, 0], [1, 0]])
WIDTH, HEIGHT, STEPS = 60, 24, 40


def river(rocks: np.ndarray) -> vj.Problem:
    """A swimmer in a river of a grid: the current takes it to the fall, unless it lands.

    Rows 6 to 17 are the river, whose current adds two cells every step; rocks stop a move upwards
    or downwards. The fall is the last column of the river.
    """
    table, moves = jnp.asarray(rocks), jnp.asarray(MOVES)

    def dynamics(t, s, action, f):
        return step(s, moves[action], table, jnp) - s

    system = vj.ode(
        dynamics, initial=lambda f, key: jnp.stack([0.0 * f["row"], f["row"]]),
        controller=lambda t, s, f: jnp.int32(0),
        signals=lambda t, s, u, f: {"fallen": fallen(s, jnp).astype(float)},
        dt=1.0, duration=float(STEPS), method="euler", exact_step=True,
    )  # fmt: skip
    return vj.Problem("river", {"row": vj.Box(6, 17)}, system, "always fallen <= 0.5")


def in_river(s):
    return (s[1] >= 6) & (s[1] <= 17)


def fallen(s, xp):
    return in_river(s) & (s[0] >= WIDTH - 1)


def step(s, move, rocks, xp):
    x = xp.clip(s[0] + move[0], 0, WIDTH - 1)
    y = xp.clip(s[1] + move[1], 0, HEIGHT - 1)
    blocked = rocks[xp.asarray(x, int), xp.asarray(y, int)]
    y = xp.where(blocked, s[1], y)
    x = xp.clip(x + 2 * in_river(xp.stack([x, y])), 0, WIDTH - 1)
    stays = fallen(s, xp)
    return xp.stack([xp.where(stays, s[0], x), xp.where(stays, s[1], y)])


def grid(rng):
    """The river, solved by induction over the steps that are left."""
    rocks = rng.random((WIDTH, HEIGHT)) < 0.25
    rocks[:, [*range(6), *range(18, 24)]] = False
    row = float(rng.integers(9, 15))
    cells = [(x, y) for x in range(WIDTH) for y in range(HEIGHT)]
    safe = [{c: not fallen(np.array(c), np) for c in cells}]
    for _ in range(STEPS):
        after = safe[-1]
        now = {}
        for cell in cells:
            s = np.array(cell)
            options = (after[tuple(step(s, move, rocks, np).astype(int))] for move in MOVES)
            now[cell] = bool(not fallen(s, np) and any(options))
        safe.append(now)
    s, last = np.array([0.0, row]), -1
    for k in range(STEPS):
        if safe[STEPS - k][tuple(s.astype(int))]:
            last = k
        s = step(s, MOVES[0], rocks, np)
    return Known(river(rocks), {"row": row}, (0, 4), last + 0.5)


SYSTEMS: dict[str, Callable[[np.random.Generator], Known]] = {
    "wall": wall, "car": car, "pendulum": pendulum, "tank": tank, "grid": grid,
}  # fmt: skip
