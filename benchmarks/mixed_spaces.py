"""Problems of choices, flags, numbers and plateaus, on which slopes say little or nothing.

    python benchmarks/paired_searches.py mixed

`gear`, `cornered`, `doors` to `lanes` came after the default search, whose numbers were chosen with
the others, and `FRESH` after all of its changes: nothing was ever tuned to these. `SHARES` has the
share of samples that fail. Where the robustness leads nowhere, no search can do better than samples
of the prior; where many coordinates are choices, descents move only the others.
"""

import jax.numpy as jnp
import numpy as np

import verifai_jax as vj

DOORS, RECIPE_LIMIT, CAPPED, QUEUE = 0.938, 3.3, 0.2, 27.86
TERRACE, MENU_LIMIT, HEAT_LIMIT, DECOY, YARD = 1.85, 2.752, 1.0, 0.1684, 0.066
BRAKES, DIAL, ROSTER = 259.25, 0.0519, 0.4808
SINGLE = np.random.default_rng(47).normal(size=(5, 4))
PAIRED = 0.6 * np.random.default_rng(48).normal(size=(4, 4, 4))
COURSES = np.random.default_rng(50).normal(size=(4, 7))


def _steps(values):
    return vj.Trace({"out": jnp.atleast_1d(values)}, dt=0.1)


def _flags(count: int) -> dict[str, vj.Categorical]:
    return {f"on{i}": vj.Categorical(0, 1) for i in range(count)}


def levers(features, key):
    """A mass that eleven three-way choices push, one after the other."""
    x, v, track = features["x0"], features["v0"], []
    for i in range(11):
        push = features[f"push{i}"] - 1.0
        v = 0.8 * v + 0.35 * features["gain"] * push - 0.12 * x
        x = x + 0.5 * v
        track.append(x)
    return vj.Trace({"x": jnp.stack(track)}, dt=0.5)


def guards(features, key):
    """Flags that guard a number, as signals of their own."""
    numbers = [features[name] for name in ("a", "b", "c")]
    speed = numbers[0] + 0.6 * numbers[1] - 0.3 * numbers[2]
    flags = {name: value[None] * 1.0 for name, value in features.items() if name.startswith("on")}
    return vj.Trace({"speed": speed[None], **flags}, dt=0.1)


def alarm(features, key):
    """A number of two values: an alarm that sounds in a ball."""
    u = jnp.stack([features[f"u{i}"] for i in range(4)])
    near = jnp.linalg.norm(u - jnp.array([0.35, 0.6, 0.45, 0.7]) + 1e-9) < 0.2124
    return _steps(jnp.where(near, 1.0, 0.0))


def stairs(features, key):
    """A bowl in steps: its derivative is zero almost everywhere."""
    u = jnp.stack([features[f"u{i}"] for i in range(5)])
    bowl = jnp.linalg.norm(u - jnp.array([0.3, 0.7, 0.55, 0.4, 0.25]) + 1e-9)
    return _steps(-jnp.ceil(8 * (bowl - 0.2705)) / 8)


def modes(features, key):
    """Six modes, each a bowl of its own, of which one goes below zero."""
    mode = features["mode"]
    u = jnp.stack([features[f"u{i}"] for i in range(4)])
    centre = jnp.array([0.2, 0.8, 0.5, 0.35]) + 0.09 * mode * jnp.array([1.0, -1.0, 0.5, 0.7])
    bowl = jnp.linalg.norm(u - centre + 1e-9) + jnp.array([0.3, 0.2, 0.1, 0.0, 0.15, 0.25])[mode]
    return _steps(0.188 - bowl)


def gear(features, key):
    """A bowl for each gear, of which one goes below zero, far from the middle of the space."""
    u, which = jnp.stack([features[f"u{i}"] for i in range(6)]), features["gear"]
    shift = 0.05 * which * jnp.array([1, -1, 1, -1, -1, 1.0])
    bowl = jnp.linalg.norm(u - jnp.array([0.15, 0.85, 0.3, 0.75, 0.9, 0.2]) - shift + 1e-9)
    return _steps(0.3 - bowl - jnp.array([0.4, 0.32, 0.0, 0.2, 0.5])[which])


def cornered(features, key):
    """A flag, and numbers that fail in a corner where it is set."""
    u = jnp.stack([features[f"u{i}"] for i in range(5)])
    ways = jnp.array([1, -1, 1, 1, -1.0])
    other = ways * jnp.array([1, 1, -1, 1, 1.0])
    return _steps(jnp.where(features["on0"] == 1, u @ ways - 2.45, u @ other - 3.2))


def votes(features, key):
    """Twelve flags that count unequally, and two numbers."""
    flags = jnp.stack([features[f"on{i}"] * 1.0 for i in range(12)])
    weights = jnp.array([3, -2, 4, 1, -3, 2, 1, -1, 2, -4, 3, 1.0])
    return _steps(flags @ weights + 2 * features["a"] - 3 * features["b"] - 14.72)


def counts(features, key):
    """Whole numbers with an order, and two numbers, as in a queue."""
    load = features["cars"] * (1 + features["rate"]) - 2.2 * features["lanes"] * features["flow"]
    late = jnp.where(features["shift"] == 2, 4.0, 0.0)
    return _steps(load + late - 22.07)


def misled(features, key):
    """A slope that leads to a face of the cube, and failures that lie elsewhere."""
    u = jnp.stack([features[f"u{i}"] for i in range(3)])
    away = jnp.linalg.norm(u - jnp.array([0.5, 0.35, 0.6]) + 1e-9)
    return _steps(jnp.where(away < 0.1337, 1.0, -1.0 + away))


def doors(features, key):
    """Five flags of which one combination opens; elsewhere all values are the same."""
    flags = jnp.stack([features[f"on{i}"] for i in range(5)])
    opened = jnp.all(flags == jnp.array([1, 0, 1, 1, 0]))
    far = features["a"] + features["b"] * features["c"] - DOORS
    return _steps(jnp.where(opened, far, -1.0))


def recipe(features, key):
    """Five choices of four that pay singly and in pairs, and five numbers."""
    chosen = [features[f"part{i}"] for i in range(5)]
    worth = sum(jnp.asarray(SINGLE)[i, part] for i, part in enumerate(chosen))
    worth += sum(jnp.asarray(PAIRED)[i, chosen[i], chosen[i + 1]] for i in range(4))
    best = jnp.array([0.2, 0.7, 0.5, 0.9, 0.35])
    u = jnp.stack([features[f"u{i}"] for i in range(5)])
    return _steps(worth - 3 * jnp.sum((u - best) ** 2) - RECIPE_LIMIT)


def capped(features, key):
    """A bowl whose rim is flat: it covers all but a part of the space, for the right two flags."""
    u = jnp.stack([features[f"u{i}"] for i in range(4)])
    bowl = jnp.linalg.norm(u - jnp.array([0.7, 0.3, 0.6, 0.2]) + 1e-9)
    wrong = 0.3 * (features["on0"] != 1) + 0.2 * (features["on1"] != 0)
    return _steps(-jnp.clip(bowl + wrong - CAPPED, -1.0, 0.15))


def queue(features, key):
    """Whole numbers, a rate and a flag that multiply."""
    load = features["jobs"] * features["size"] * (1 + features["rate"])
    servers = features["servers"] * (2.0 - features["slow"]) * (1 + 0.5 * features["speed"])
    return _steps(load / servers - QUEUE)


def lanes(features, key):
    """A choice, a flag and a whole number that guard a number, as signals of their own."""
    speed = features["v"] * (1 + 0.1 * features["gear"]) - 0.4 * features["load"]
    return vj.Trace(
        {"speed": speed[None], "gear": features["gear"][None] * 1.0,
         "lane": features["lane"][None] * 1.0, "wet": features["wet"][None] * 1.0}, dt=0.1,
    )  # fmt: skip


def terraces(features, key):
    """Three levels of a field over six numbers, and a choice that moves it."""
    u = jnp.stack([features[f"u{i}"] for i in range(6)])
    shift = jnp.array([0.0, 0.15, -0.1, 0.3])[features["site"]]
    height = jnp.sin(3 * u[0] + shift) + u[1] * u[2] - 0.7 * jnp.abs(u[3] - 0.4) + 0.3 * u[4] * u[5]
    return _steps(jnp.digitize(height, jnp.array([0.9, 1.4, TERRACE])) - 2.5)


def valve(features, key):
    """A tank that ten flags fill or empty, one after the other, at rates that are numbers."""
    level, track = features["start"], []
    for i in range(10):
        level = level + features["rate"] * (2.0 * features[f"on{i}"] - 1) - 0.08 * level**2
        track.append(level)
    return vj.Trace({"level": jnp.stack(track)}, dt=1.0)


def menu(features, key):
    """Three choices of seven that pay singly and in a pair, and three numbers."""
    one, two, three = (features[f"course{i}"] for i in range(3))
    worth = jnp.asarray(COURSES)[0, one] + jnp.asarray(COURSES)[1, two]
    worth += jnp.asarray(COURSES)[2, three] + 0.8 * jnp.asarray(COURSES)[3, (one + 2 * three) % 7]
    u = jnp.stack([features[f"u{i}"] for i in range(3)])
    return _steps(worth + jnp.sum(u * jnp.array([0.8, -0.6, 0.5])) - MENU_LIMIT)


def interlock(features, key):
    """Two flags and a whole number that guard a temperature; fails often."""
    heat = features["power"] * (1 + features["sun"]) - 0.5 * features["flow"]
    names = ("door", "key", "zone")
    return vj.Trace({"heat": heat[None], **{n: features[n][None] * 1.0 for n in names}}, dt=0.1)


def digits(features, key):
    """Six digits of four of which five must be right; what counts is how many are."""
    given = jnp.stack([features[f"digit{i}"] for i in range(6)])
    return _steps(jnp.sum(given == jnp.array([2, 0, 3, 1, 1, 2])) - 4.5)


def decoy(features, key):
    """A flag under which slopes lead away from the failures, which are as many as one in 100."""
    u = jnp.stack([features[f"u{i}"] for i in range(3)])
    away = jnp.linalg.norm(u - jnp.array([0.75, 0.3, 0.6]) + 1e-9)
    return _steps(
        jnp.where(features["on0"] == 1, jnp.where(away < DECOY, 1.0, away - 1.5), -u[0] - 1)
    )


def yard(features, key):
    """A point on a lattice of 40 by 40, whose robustness is capped, and a heading."""
    x, y = features["x"] / 40.0, features["y"] / 40.0
    far = jnp.hypot(x - 0.7, y - 0.2) + 0.2 * jnp.abs(features["heading"] - 0.3)
    return _steps(YARD - jnp.clip(far, 0.0, 0.3))


def brakes(features, key):
    """The metres missing to stop, in halves, on one of four roads with one of three tyres."""
    grip = jnp.array([0.9, 0.7, 0.5, 0.25])[features["road"]]
    grip *= jnp.array([1.0, 0.85, 0.7])[features["tyre"]]
    braking = features["speed"] ** 2 / (2 * 9.81 * grip) * (1 + 0.05 * features["riders"])
    left = features["gap"] - features["speed"] * (0.3 + features["delay"]) - braking
    return _steps(-jnp.floor(2 * left) / 2)


def dial(features, key):
    """Eight flags that are the digits of a number, and a second number that has to match it."""
    flags = jnp.stack([features[f"on{i}"] * 1.0 for i in range(8)])
    number = flags @ 2.0 ** jnp.arange(8) / 255
    far = jnp.hypot(number - 0.62, 0.5 * (features["a"] - number**2)) + 0.1 * features["b"]
    return _steps(DIAL - far)


def roster(features, key):
    """Five shifts of five people; what counts is how many meet, and how tired they are."""
    who = jnp.stack([features[f"shift{i}"] for i in range(5)])
    meet = jnp.sum((who[:, None] == who[None]) & (jnp.arange(5)[:, None] < jnp.arange(5)))
    tired = jnp.sum(jnp.abs(who - jnp.array([0, 3, 1, 4, 2]))) / 10
    return _steps(features["a"] + 0.5 * features["b"] * features["a"] - 0.3 * meet - tired - ROSTER)


def _box(count: int) -> dict[str, vj.Box]:
    return {f"u{i}": vj.Box(0, 1) for i in range(count)}


def _guarded(flags: int, limit: float) -> vj.Problem:
    space = {"a": vj.Box(0, 1), "b": vj.Box(0, 1), "c": vj.Box(0, 1), **_flags(flags)}
    guard = " and ".join(f"on{i} > 0.5" for i in range(flags))
    name = f"guards_{flags}"
    return vj.Problem(name, space, guards, f"always (({guard}) -> speed < {limit})")


PUSHES = {f"push{i}": vj.Categorical(0, 1, 2) for i in range(11)}
NUMBERS = {"x0": vj.Box(-1, 1), "v0": vj.Box(-1, 1), "gain": vj.Box(0.5, 1.5)}
PROBLEMS = {
    problem.name: problem
    for problem in (
        vj.Problem("levers", NUMBERS | PUSHES, levers, "always x < 3.34"),
        _guarded(2, 1.07),
        _guarded(4, 1.02),
        vj.Problem("alarm", _box(4), alarm, "always out < 0.5"),
        vj.Problem("stairs", _box(5), stairs, "always out < -0.06"),
        vj.Problem(
            "modes", {"mode": vj.Categorical(*range(6)), **_box(4)}, modes, "always out < 0"
        ),
        vj.Problem("gear", {"gear": vj.Categorical(*range(5)), **_box(6)}, gear,
                   "always out < 0"),
        vj.Problem("cornered", _box(5) | _flags(1), cornered, "always out < 0"),
        vj.Problem("votes", {"a": vj.Box(0, 1), "b": vj.Box(0, 1), **_flags(12)}, votes,
                   "always out < 0"),
        vj.Problem(
            "counts",
            {"cars": vj.DiscreteBox(0, 12), "lanes": vj.DiscreteBox(1, 4),
             "shift": vj.Categorical(0, 1, 2), "rate": vj.Box(0, 1), "flow": vj.Box(0.2, 1)},
            counts, "always out < 0",
        ),
        vj.Problem("misled", _box(3), misled, "always out < 0"),
        vj.Problem("doors", {name: vj.Box(0, 1) for name in "abc"} | _flags(5), doors,
                   "always out < 0"),
        vj.Problem("recipe", _box(5) | {f"part{i}": vj.Categorical(0, 1, 2, 3) for i in range(5)},
                   recipe, "always out < 0"),
        vj.Problem("capped", _box(4) | _flags(2), capped, "always out < 0"),
        vj.Problem(
            "queue",
            {"jobs": vj.DiscreteBox(1, 20), "servers": vj.DiscreteBox(1, 8),
             "slow": vj.Categorical(0, 1), "size": vj.Box(0.5, 2), "rate": vj.Box(0, 1),
             "speed": vj.Box(0, 1)},
            queue, "always out < 0",
        ),
        vj.Problem(
            "lanes",
            {"gear": vj.DiscreteBox(1, 6), "lane": vj.Categorical(0, 1, 2),
             "wet": vj.Categorical(0, 1), "v": vj.Box(0, 1), "load": vj.Box(0, 1)},
            lanes, "always ((lane > 1.5 and wet > 0.5 and gear < 2.5) -> speed < 0.8)",
        ),
    )
}  # fmt: skip
"""By name."""

FRESH = {
    problem.name: problem
    for problem in (
        vj.Problem("terraces", _box(6) | {"site": vj.Categorical(*range(4))}, terraces,
                   "always out < 0"),
        vj.Problem("valve", {"start": vj.Box(0, 1), "rate": vj.Box(0.5, 1.5), **_flags(10)}, valve,
                   "always level < 4.25"),
        vj.Problem("menu", _box(3) | {f"course{i}": vj.Categorical(*range(7)) for i in range(3)},
                   menu, "always out < 0"),
        vj.Problem(
            "interlock",
            {"door": vj.Categorical(0, 1), "key": vj.Categorical(0, 1),
             "zone": vj.DiscreteBox(1, 4), "power": vj.Box(0, 1), "sun": vj.Box(0, 1),
             "flow": vj.Box(0, 1)},
            interlock, f"always ((door > 0.5 and key < 0.5 and zone > 2.5) -> heat < {HEAT_LIMIT})",
        ),
        vj.Problem("digits", {f"digit{i}": vj.Categorical(0, 1, 2, 3) for i in range(6)}, digits,
                   "always out < 0"),
        vj.Problem("decoy", _box(3) | _flags(1), decoy, "always out < 0"),
        vj.Problem("yard", {"x": vj.DiscreteBox(0, 39), "y": vj.DiscreteBox(0, 39),
                            "heading": vj.Box(0, 1)}, yard, "always out < 0"),
        vj.Problem(
            "brakes",
            {"road": vj.Categorical(0, 1, 2, 3), "tyre": vj.Categorical(0, 1, 2),
             "riders": vj.DiscreteBox(1, 5), "speed": vj.Box(5, 30), "gap": vj.Box(20, 90),
             "delay": vj.Box(0, 1)},
            brakes, f"always out < {BRAKES}",
        ),
        vj.Problem("dial", {"a": vj.Box(0, 1), "b": vj.Box(0, 1), **_flags(8)}, dial,
                   "always out < 0"),
        vj.Problem("roster", {"a": vj.Box(0, 1), "b": vj.Box(0, 1)}
                   | {f"shift{i}": vj.Categorical(*range(5)) for i in range(5)},
                   roster, "always out < 0"),
    )
}  # fmt: skip
"""Those that nothing was tuned to."""

SHARES = {
    "levers": 2.0e-3,
    "guards_2": 3.1e-2,
    "guards_4": 1.02e-2,
    "alarm": 1.01e-2,
    "stairs": 7.8e-3,
    "modes": 1.17e-3,
    "gear": 7.4e-4,
    "cornered": 2.2e-4,
    "votes": 2.65e-3,
    "counts": 1.0e-2,
    "misled": 1.0e-2,
    "doors": 1.0e-2,
    "recipe": 3.0e-3,
    "capped": 2.0e-3,
    "queue": 1.0e-2,
    "lanes": 7.5e-3,
    "terraces": 1.7e-3,
    "valve": 1.9e-3,
    "menu": 3.0e-3,
    "interlock": 2.1e-2,
    "digits": 4.8e-3,
    "decoy": 1.0e-2,
    "yard": 3.0e-3,
    "brakes": 3.1e-3,
    "dial": 3.0e-3,
    "roster": 1.0e-2,
}
"""Of 400 000 samples; those of `FRESH` of 200 000."""
