"""What `vj.compare` catches, how often it cries wolf, and what it costs beside unpaired testing.

python benchmarks/compare.py                        # everything: about 15 minutes on two cores
python benchmarks/compare.py --repeats 20 --regressions 2

Five controllers in closed loop. Ten regressions each are injected into their gains, chosen so that
the failure probability rises by 0.5 to 5 percentage points; the rise is measured on other samples.
Policies that are equal but not the same read a sensor whose offset is drawn anew: their failure
probabilities are exactly equal, though other simulations fail. Unpaired testing is computed for the
measured rates: the fixed sample of a test that knows the difference in advance (two proportions,
5 % two-sided, power 95 %), and one that stops at any time, on independent samples of both sides.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import norm

import verifai_jax as vj
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.statistics.confidence_sequences import anytime_interval

BUDGET = 100_000
"""Simulations of a comparison at most, the default of `vj.compare`."""
RISES = np.geomspace(0.005, 0.05, 10)
"""Rises of the failure probability that are injected."""
GAINS = np.linspace(1.0, 0.3, 36)
"""Gains among which those of the regressions are looked for."""
CALIBRATION, MEASUREMENT = 1 << 15, 1 << 16
"""Simulations with which a gain is chosen, and other ones with which its rise is measured."""


class Controller(NamedTuple):
    """A closed loop whose controller has a gain.

    - `space`: features of the plant.
    - `start`: `features -> state`.
    - `dynamics`: `(state, control, features) -> derivatives`.
    - `control`: `(gain, state, offset, features) -> control`, with an offset of the sensor.
    - `spec`: of the loop.
    - `offset`: standard deviation of the sensor's offset.
    """

    space: dict[str, Any]
    start: Callable[..., Any]
    dynamics: Callable[..., Any]
    control: Callable[..., Any]
    spec: str
    offset: float

    def problem(self, name: str, gain: float | None, other: bool = False) -> vj.Problem:
        """Make the problem; without a gain it is a feature. `other`: draw another offset."""

        def initial(features, key):
            key = jax.random.fold_in(key, 1) if other else key
            offset = self.offset * jax.random.normal(key)
            return {**self.start(features), "offset": offset}

        def dynamics(time, state, control, features):
            return {**self.dynamics(state, control, features), "offset": jnp.zeros(())}

        def control(time, state, features):
            own = features["gain"] if gain is None else gain
            return self.control(own, state, state["offset"], features)

        system = vj.ode(
            dynamics, initial, controller=control, dt=0.02, duration=4.0, method="euler",
            signals=lambda time, state, control, features: {
                key: value for key, value in state.items() if key != "offset"
            },
        )  # fmt: skip
        more = {"gain": vj.Box(0.0, 2.0)} if gain is None else {}
        return vj.Problem(name, {**self.space, **more}, system, self.spec)


CONTROLLERS = {
    "pendulum": Controller(
        {
            "angle": vj.Normal(0.0, 0.2),
            "speed": vj.Normal(0.0, 0.6),
            "mass": vj.LogUniform(0.8, 1.3),
        },
        lambda f: {"angle": f["angle"], "speed": f["speed"]},
        lambda s, u, f: {"angle": s["speed"], "speed": 9.81 * jnp.sin(s["angle"]) + u / f["mass"]},
        lambda k, s, o, f: jnp.clip(-k * (13.5 * (s["angle"] + o) + 3.2 * s["speed"]), -6.5, 6.5),
        "always abs(angle) <= 0.6",
        0.02,
    ),
    "altitude": Controller(
        {
            "height": vj.Normal(0.0, 1.0),
            "climb": vj.Normal(0.0, 0.5),
            "wind": vj.Normal(0.0, 0.6),
        },
        lambda f: {"height": f["height"], "climb": f["climb"]},
        lambda s, u, f: {"height": s["climb"], "climb": u + f["wind"]},
        lambda k, s, o, f: jnp.clip(-k * (5.0 * (s["height"] + o) + 3.5 * s["climb"]), -4.0, 4.0),
        "always[2.5, 4] abs(height) <= 0.3",
        0.02,
    ),
    "cruise": Controller(
        {
            "gap": vj.Normal(35.0, 4.0),
            "own": vj.Normal(20.0, 1.5),
            "braking": vj.Normal(3.0, 1.2),
        },
        lambda f: {"gap": f["gap"], "own": f["own"], "lead": jnp.asarray(20.0)},
        lambda s, u, f: {
            "gap": s["lead"] - s["own"],
            "own": jnp.where((s["own"] > 0) | (u > 0), u, 0.0),
            "lead": jnp.where(s["lead"] > 0, -f["braking"], 0.0),
        },
        lambda k, s, o, f: jnp.clip(
            k * (0.18 * (s["gap"] + o - 1.2 * s["own"] - 5.0) + 0.8 * (s["lead"] - s["own"])),
            -7.0,
            2.0,
        ),
        "always gap >= 12",
        0.5,
    ),
    "lane": Controller(
        {
            "side": vj.Normal(0.0, 0.4),
            "heading": vj.Normal(0.0, 0.06),
            "curvature": vj.Normal(0.0, 0.004),
            "speed": vj.Normal(20.0, 2.0),
        },
        lambda f: {"side": f["side"], "heading": f["heading"]},
        lambda s, u, f: {
            "side": f["speed"] * jnp.sin(s["heading"]),
            "heading": f["speed"] * (jnp.tan(u) / 2.7 - f["curvature"]),
        },
        lambda k, s, o, f: jnp.clip(-k * (0.02 * (s["side"] + o) + 0.25 * s["heading"]), -0.3, 0.3),
        "always abs(side) <= 1.5",
        0.05,
    ),
    "motor": Controller(
        {
            "load": vj.Normal(0.4, 0.12),
            "friction": vj.LogUniform(0.6, 1.6),
            "speed": vj.Normal(0.0, 0.2),
        },
        lambda f: {"speed": f["speed"], "integral": jnp.zeros(())},
        lambda s, u, f: {
            "speed": jnp.clip(u, -4.0, 4.0) - f["friction"] * s["speed"] - f["load"],
            "integral": 1.0 - s["speed"],
        },
        lambda k, s, o, f: k * (4.0 * (1.0 + o - s["speed"]) + 3.0 * s["integral"]),
        "always[2, 4] abs(speed - 1) <= 0.1",
        0.02,
    ),
}


class Regression(NamedTuple):
    """An injected regression: its gain, and both rates as measured."""

    gain: float
    before: float
    after: float


def failing(evaluate: Evaluator, gain: float, samples: int, seed: int) -> np.ndarray:
    """Return which of many samples fail with a gain; the same samples for every gain."""
    u = np.random.default_rng(seed).random((samples, evaluate.problem.space.dim), np.float32)
    index = list(evaluate.problem.space.columns).index("gain")
    u[:, index] = gain / 2.0
    return np.asarray(evaluate(u, first=0).violated, bool)


def regressions(name: str, controller: Controller, count: int) -> list[Regression]:
    """Choose gains whose failure probability is higher by the rises that are wanted."""
    evaluate = Evaluator(controller.problem(name, None), 4096, seed=1)
    rates = np.array([failing(evaluate, k, CALIBRATION, 1).mean() for k in GAINS])
    rises = np.maximum.accumulate(rates - rates[0])
    assert rises[-1] > RISES[-1], f"{name} does not fail {RISES[-1]:.0%} more: {rises}"
    wanted = RISES[np.unique(np.linspace(0, len(RISES) - 1, count).round().astype(int))]
    before = failing(evaluate, 1.0, MEASUREMENT, 2).mean()
    chosen = [float(np.interp(rise, rises, GAINS)) for rise in wanted]
    return [
        Regression(k, float(before), float(failing(evaluate, k, MEASUREMENT, 2).mean()))
        for k in chosen
    ]


def fixed_sample(before: float, after: float, power: float = 0.95) -> int:
    """Return the simulations of both sides of an unpaired test that knows the difference."""
    z = norm.isf(0.025) + norm.isf(1 - power)
    variance = before * (1 - before) + after * (1 - after)
    return 2 * int(np.ceil(z**2 * variance / (after - before) ** 2))


def unpaired(before: float, after: float, rng: np.random.Generator) -> int:
    """Return the simulations of an unpaired comparison that stops when its intervals part."""
    size, fails, samples = 256, np.zeros(2, int), 0
    while 2 * samples < 100 * BUDGET:
        fails += rng.binomial(size, [before, after])
        samples += size
        one, two = (anytime_interval(int(n), samples, 0.975) for n in fails)
        if one.high < two.low or two.high < one.low:
            break
        size = min(2 * size, 4096)
    return 2 * samples


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--regressions", type=int, default=10, help="of each controller")
    parser.add_argument("--seeds", type=int, default=3, help="comparisons of each regression")
    parser.add_argument("--repeats", type=int, default=200, help="of equal policies, in all")
    parser.add_argument("--only", choices=list(CONTROLLERS))
    options = parser.parse_args()
    began = time.perf_counter()
    rng = np.random.default_rng(0)
    chosen = {n: c for n, c in CONTROLLERS.items() if options.only in (None, n)}
    caught, false, equal = [], [], []
    paired, fixed, stopped = [], [], []
    for name, controller in chosen.items():
        base = controller.problem(name, 1.0)
        ours: list[float] = []
        theirs: list[float] = []
        for number, one in enumerate(regressions(name, controller, options.regressions)):
            changed = controller.problem(name, one.gain)
            results = [
                vj.compare(base, changed, budget=BUDGET, seed=100 * number + seed)
                for seed in range(options.seeds)
            ]
            caught.append([result.regression for result in results])
            needed = [result.simulations for result in results]
            paired.append(np.mean(needed))
            fixed.append(fixed_sample(one.before, one.after))
            stopped.append(np.mean([unpaired(one.before, one.after, rng) for _ in range(20)]))
            ours.append(paired[-1] / fixed[-1])
            theirs.append(paired[-1] / stopped[-1])
            print(
                f"{name:9} gain {one.gain:.3f}: {100 * one.before:5.2f} % -> "
                f"{100 * one.after:5.2f} %, caught {sum(caught[-1])} of {len(results)}, "
                f"{paired[-1]:8,.0f} simulations; unpaired {fixed[-1]:8,} fixed, "
                f"{stopped[-1]:9,.0f} at any time",
                flush=True,
            )
        other = controller.problem(name, 1.0, other=True)
        repeats = options.repeats // len(chosen)
        verdicts = [
            vj.compare(base, other, budget=BUDGET, seed=10_000 + seed) for seed in range(repeats)
        ]
        false.append(sum(result.verdict == "worse" for result in verdicts))
        equal.append(len(verdicts))
        apart = np.mean([len(r.candidates[0].discordant) for r in verdicts])
        print(
            f"{name:9} equal: {false[-1]} of {equal[-1]} called worse, "
            f"{sum(r.verdict == 'better' for r in verdicts)} better; {apart:,.0f} pairs of "
            f"{BUDGET // 2:,} differ; ratios {np.median(ours):.2f} and {np.median(theirs):.2f}; "
            f"{time.perf_counter() - began:.0f} s",
            flush=True,
        )
    hits = np.array(caught)
    print(f"\ncaught {hits.sum()} of {hits.size} ({100 * hits.mean():.1f} %)")
    print(f"{int((hits.mean(axis=1) > 0.5).sum())} of {len(hits)} regressions in most seeds")
    print(
        f"called worse {sum(false)} of {sum(equal)} equal ({100 * sum(false) / sum(equal):.1f} %)"
    )
    for label, other in (("fixed", fixed), ("at any time", stopped)):
        ratios = np.array(paired) / np.array(other)
        print(
            f"simulations, paired over unpaired ({label}): {np.sum(paired) / np.sum(other):.3f} of "
            f"the sum; median {np.median(ratios):.3f}, {np.quantile(ratios, 0.1):.3f} to "
            f"{np.quantile(ratios, 0.9):.3f} (10 to 90 %), greatest {ratios.max():.3f}"
        )
    print(f"{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
