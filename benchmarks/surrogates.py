"""Simulations to the first failure of slow black boxes: surrogates and what they are measured by.

    python benchmarks/surrogates.py [--seeds 20] [--systems vehicle40] [--searches bayes]

The black boxes stand for simulators of a second and more, of which only the number of simulations
counts; they are fast here. Each is a NumPy function that JAX cannot see into, with an input signal
of 10 or 40 equal pieces. Failures are planted by the bounds of the formulas, so that uniform
sampling meets one in thousands of simulations or never.
"""

import argparse
import time

import numpy as np

import verifai_jax as vj

SEARCHES = ("trace_surrogate", "turbo", "bayes", "portfolio", "uniform")


def steps(signal, horizon, dt):
    """Return the samples of a signal of equal pieces."""
    count = round(horizon / dt)
    return np.asarray(signal)[np.arange(count) * len(signal) // count]


def oscillator(features):
    """A damped Duffing oscillator under a piecewise constant force."""
    dt, horizon = 0.05, 20.0
    force = steps(features["force"], horizon, dt)
    x, v, xs, vs = 0.0, 0.0, [0.0], [0.0]
    for f in force:
        v += dt * (f - 0.3 * v - 1.5 * x - 0.4 * x**3)
        x += dt * v
        xs.append(x)
        vs.append(v)
    return vj.Trace({"x": np.array(xs), "v": np.array(vs)}, dt=dt)


def vehicle(features):
    """A kinematic car with lag in its steering that is driven along a lane; gusts push it."""
    dt, horizon = 0.05, 20.0
    gust = steps(features["gust"], horizon, dt)
    y, heading, steer, ys, rates = 0.0, 0.0, 0.0, [0.0], [0.0]
    for g in gust:
        wanted = np.clip(-0.06 * y - 0.5 * heading, -0.12, 0.12)
        steer += dt * 4.0 * (wanted - steer)
        heading += dt * (15.0 / 2.7 * np.tan(steer) + 0.3 * g)
        y += dt * 15.0 * np.sin(heading)
        ys.append(y)
        rates.append(steer)
    return vj.Trace({"y": np.array(ys), "steer": np.array(rates)}, dt=dt)


def tanks(features):
    """Three tanks in a row with valves, square-root outflow; the pump's commands are the input."""
    dt, horizon = 0.25, 100.0
    pump = steps(features["pump"], horizon, dt)
    h = np.array([1.0, 1.0, 1.0])
    levels = [h]
    for p in pump:
        out = 0.35 * np.sqrt(np.maximum(h, 0.0))
        h = np.maximum(h + dt * np.array([p - out[0], out[0] - out[1], out[1] - out[2]]), 0.0)
        levels.append(h)
    levels = np.array(levels)
    return vj.Trace({"first": levels[:, 0], "last": levels[:, 2]}, dt=dt)


def problem(name, count, system, domain, formula):
    """Return a black-box problem whose input has `count` control points."""
    space = {name: vj.Array(domain, length=count)}
    return vj.Problem(f"{system.__name__}{count}", space, vj.blackbox(system), formula)


def problems():
    """Name -> problem."""
    force, gust, pump = vj.Box(-1.0, 1.0), vj.Box(-1.0, 1.0), vj.Box(0.1, 0.6)
    drained = "not (eventually (last > 2.5 and eventually last < 0.3))"
    return {
        "oscillator10": problem("force", 10, oscillator, force, "always x < 2.2"),
        "oscillator40": problem("force", 40, oscillator, force, "always x < 2.2"),
        "vehicle10": problem("gust", 10, vehicle, gust, "always abs(y) < 1.43"),
        "vehicle40": problem("gust", 40, vehicle, gust, "always abs(y) < 2"),
        "tanks10": problem("pump", 10, tanks, pump, drained),
        "tanks40": problem("pump", 40, tanks, pump, drained),
    }


def first_failure(what, search, seed, budget):
    """Return the number of the first simulation that fails, and whether there is one."""
    run = vj.falsify(
        what, search, budget, batch=512 if search == "uniform" else 8, seed=seed,
        stop=vj.Stop(after=1), progress=False,
    )  # fmt: skip
    failing = np.flatnonzero(run.table.all["violated"])
    return (int(failing[0]) + 1, True) if len(failing) else (budget, False)


def main():
    """Measure and print one line for each system and search."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--systems", default="", help="names, comma-separated")
    parser.add_argument("--searches", default=",".join(SEARCHES))
    parser.add_argument("--budget", type=int, default=1000)
    options = parser.parse_args()
    known = problems()
    for name in options.systems.split(",") if options.systems else known:
        for search in options.searches.split(","):
            started = time.perf_counter()
            found = [
                first_failure(known[name], search, seed, options.budget)
                for seed in range(options.seeds)
            ]
            counts = [count for count, _ in found]
            low, middle, high = np.percentile(counts, [25, 50, 75])
            print(
                f"{name:<14}{search:<17}{sum(f for _, f in found):>3}/{options.seeds}"
                f"{middle:>8.0f}{f'{low:.0f} - {high:.0f}':>14}{np.mean(counts):>8.0f}"
                f"{time.perf_counter() - started:>8.1f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
