"""How much advance notice does it take to avoid the accident of Tempe?

    verifai-jax falsify specs/tempe.py:unwarned --search uniform --budget 10000
    verifai-jax estimate specs/tempe.py:accident
    verifai-jax repair specs/tempe.py:accident --parameters notice
    verifai-jax falsify specs/tempe.py:tempe

The situation of the VerifAI paper (CAV 2019, section 3.1): `envs/road/tempe.py`. A smart
intersection tells the straight car `notice` seconds ahead that a car is about to turn left into its
way. The paper samples variations to find how much notice avoids the accident robustly, and gives no
number.

It is assumed here that braking at once avoids every crash, that is, that the straight car is at
least 45 m from the middle of the intersection when the simulation begins: at 50 km/h and 6 m/s^2 it
halts within 22 m of the message, and its stop line is 33 m from its front. Nearer than that, a car
that cannot halt any more goes on and is through before the other one comes: with 2 s of notice no
sample from 25 to 45 m collides either.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import verifai_jax as vj
from envs.road.tempe import LANE, NOMINAL, PICTURE, STOP_LINE
from envs.road.tempe import tempe as intersection
from verifai_jax.search import PointList
from verifai_jax.statistics.binomial import clopper_pearson

SAFE = "always gap > 0"
CALM = "always acceleration > -6"
FLOW = "eventually ego_y > 10"
PREMISE = "always (until_conflict > 0.5 -> visible < 0)"
"""Stopped traffic hides the cars from each other until half a second before they meet."""

MAX_NOTICE = 4.0

PROGRAM = Path(__file__).with_name("tempe.scenic")
"""The same situation as a Scenic program."""

space = vj.FeatureSpace(
    {
        "ego_dist": vj.Box(45.0, 75.0),
        "ego_speed": vj.Box(30.0, 50.0),
        "turn_start": vj.Box(-12.0, -5.0),
        "turn_speed": vj.Box(20.0, 35.0),
        "delay": vj.Box(0.0, 3.0),
        "reaction": vj.Box(0.1, 0.3),
        "brake": vj.Box(6.0, 8.5),
        "notice": vj.Box(0.0, MAX_NOTICE),
    }
)

views = vj.FeatureSpace({**space.domains, "block_noise": vj.Box(-0.5, 0.5)})
"""With where the stopped cars stand, which matters to who can see."""

unseeing = {name: NOMINAL[name] for name in space.domains}

tempe = vj.Problem(
    "tempe",
    space,
    intersection(),
    {"safe": SAFE, "calm": CALM, "flow": FLOW},
    priority=["safe", "calm", "flow"],
    nominal=unseeing,
    description="no collision first, then no emergency braking, then get across in time",
    draw=PICTURE,
)

accident = vj.Problem(
    "accident",
    space,
    intersection(),
    SAFE,
    nominal=unseeing,
    description="no collision, whatever the notice: the notice is a parameter to choose",
    draw=PICTURE,
)

brief = vj.Problem(
    "brief",
    space,
    intersection(),
    {"safe": SAFE, "brief": "always notice < 2.3"},
    nominal={**unseeing, "notice": 2.0},
    description="no collision, and no longer notice than that takes: to be synthesized",
    draw=PICTURE,
)

premise = vj.Problem(
    "premise",
    views,
    intersection(),
    PREMISE,
    description="stopped traffic hides the cars from each other until just before they meet",
    draw=PICTURE,
)

seeing = vj.Problem(
    "seeing",
    views,
    intersection(eyes=True),
    SAFE,
    nominal=NOMINAL,
    description="no collision, of a car that also brakes for what it sees",
    draw=PICTURE,
)


def warned(notice: float, problem: vj.Problem = accident) -> vj.Problem:
    """Return the problem with the notice held at so many seconds."""
    nominal = None if problem.nominal is None else {**problem.nominal, "notice": notice}
    return vj.Problem(
        f"{problem.name}_{notice:g}",
        problem.space.fixed(notice=notice),
        problem.system,
        problem.spec,
        nominal=nominal,
        description=f"{problem.description}; warned {notice:g} s ahead",
        draw=problem.draw,
    )


unwarned = warned(0.0)


def collisions(
    notices: Sequence[float], samples: int = 10_000, seed: int = 0, problem: vj.Problem = accident
) -> pd.DataFrame:
    """Simulate the same `samples` of all other features under each notice.

    **Returns:** a row for each notice: `collisions`, their `share` with its exact 95 % interval
    (`low`, `high`; Clopper and Pearson), and the `worst_gap` in m.
    """
    features = list(problem.space.domains)
    # `notice`, and `param.notice` where a Scenic program varies it.
    (chosen,) = (i for i, name in enumerate(features) if name.endswith("notice"))
    points = np.random.default_rng(seed).uniform(size=(samples, len(features)))
    rows = []
    for notice in notices:
        points[:, chosen] = notice / MAX_NOTICE
        run = vj.falsify(
            problem, PointList(points), samples, batch=4096, confirm=False, progress=False
        )
        table = run.table.all
        rate = clopper_pearson(int(np.sum(table["violated"])), samples)
        worst = float(np.min(table["rho"]))
        rows.append((notice, rate.failures, rate.estimate, rate.low, rate.high, worst))
    names = pd.Index(["notice", "collisions", "share", "low", "high", "worst_gap"])
    return pd.DataFrame(rows, columns=names).set_index("notice")


def from_scenic() -> vj.Problem:
    """Return `accident` over the scenes of the Scenic program beside this file.

    **Raises:** `MissingExtra` where Scenic is not installed.
    """
    program = vj.scenic(PROGRAM)
    simulate = intersection()

    def of_scene(scene: Mapping[str, Any], key: Any = None) -> vj.Trace:
        ego, turning, params = scene["ego"], scene["turning"], scene["params"]
        features = {
            "ego_dist": -ego["y"],
            "ego_speed": 3.6 * ego["speed"],
            "turn_start": STOP_LINE - turning["y"],
            "turn_speed": 3.6 * turning["speed"],
            "delay": turning["delay"],
            # The first of the cars that stand, in the lane whose middle is at 1.75 m.
            "block_noise": LANE / 2 - scene["car1"]["x"],
            **params,
        }
        return simulate(features, key)

    return vj.Problem(
        "accident_of_scenic",
        program.space,
        program.system(of_scene),
        SAFE,
        description="no collision, in the scenes of the Scenic program",
        draw=PICTURE,
    )


def failing_notices(
    floor: float = 0.0,
    budget: int = 20_000,
    step: float = 0.02,
    seed: int = 0,
    problem: vj.Problem = accident,
) -> pd.DataFrame:
    """Search for collisions in spite of ever more notice, until a search finds none.

    Each search may choose the notice above a floor: of the first `floor`, of another the largest
    with which the one before found a collision, and `step` more.

    **Returns:** a row for each search: its `floor`, the `simulations`, its `collisions`, and the
    `longest` notice among these, NaN where there is none.
    """
    rows = []
    while floor < MAX_NOTICE:
        domains = {**problem.space.domains, "notice": vj.Box(floor, MAX_NOTICE)}
        above = vj.Problem(problem.name, domains, problem.system, problem.spec)
        run = vj.falsify(above, "cross_entropy", budget, seed=seed, batch=1024, progress=False)
        # Collisions that finer steps and double precision confirm.
        found = run.table.counterexamples
        longest = float(np.max(found["notice"])) if len(found) else np.nan
        rows.append((floor, len(run.table.all), len(found), longest))
        if not len(found):
            break
        floor = longest + step
    names = pd.Index(["floor", "simulations", "collisions", "longest"])
    return pd.DataFrame(rows, columns=names)
