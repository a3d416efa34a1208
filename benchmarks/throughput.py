"""Simulations per second of the cart-pole problem, side by side with vectorised NumPy.

    python benchmarks/throughput.py

Both sides simulate the same 200 steps of CartPole-v1's dynamics under the same linear controller
over four features and take the least of the two two-sided bounds; their robustness values are
compared first. NumPy runs at its best batch size, in float64 (its default) and in float32 (what
the engine computes in). `falsify(uniform)` is the call of a user with all defaults, confirmation
included. Rounds alternate between the sides; the ratio is the median of the ratios
of neighbouring rounds, which a noisy machine disturbs least. Compilation is excluded.
"""

import argparse
import importlib
import statistics
import time

import jax
import numpy as np

import verifai_jax as vj
from envs import cartpole
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.evaluation.engine import engine_for

STEPS, PERIOD = 200, 0.02
X_LIMIT, THETA_LIMIT = 2.4, 12 * 2 * np.pi / 360
RANGES = {"x0": (-0.5, 0.5), "theta0": (-0.15, 0.15), "masspole": (0.05, 0.5), "length": (0.3, 1.0)}
GAINS = (1.0, 2.0, 25.0, 5.0)


def numpy_robustness(u, dtype):
    """Robustness `[n]` of the points `[n, 4]` of the unit cube."""
    g, total_base, force_limit = dtype(9.8), dtype(1.0), dtype(10.0)
    limit_x, limit_theta, period = dtype(X_LIMIT), dtype(THETA_LIMIT), dtype(PERIOD)
    gains = [dtype(gain) for gain in GAINS]
    x, theta, masspole, length = (
        dtype(low) + u[:, i].astype(dtype) * dtype(high - low)
        for i, (low, high) in enumerate(RANGES.values())
    )
    x_dot, theta_dot = np.zeros_like(x), np.zeros_like(x)
    total, polemass_length = total_base + masspole, masspole * length
    rho = np.minimum(limit_x - np.abs(x), limit_theta - np.abs(theta))
    for _ in range(STEPS):
        force = gains[0] * x + gains[1] * x_dot + gains[2] * theta + gains[3] * theta_dot
        force = np.clip(force, -force_limit, force_limit)
        cos, sin = np.cos(theta), np.sin(theta)
        temp = (force + polemass_length * theta_dot * theta_dot * sin) / total
        theta_acc = (g * sin - cos * temp) / (
            length * (dtype(4 / 3) - masspole * cos * cos / total)
        )
        x_acc = temp - polemass_length * theta_acc * cos / total
        x, x_dot = x + period * x_dot, x_dot + period * x_acc
        theta, theta_dot = theta + period * theta_dot, theta_dot + period * theta_acc
        rho = np.minimum(rho, np.minimum(limit_x - np.abs(x), limit_theta - np.abs(theta)))
    return rho


def numpy_round(u, dtype, batch):
    """All points in batches; returns seconds."""
    started = time.perf_counter()
    for first in range(0, len(u), batch):
        numpy_robustness(u[first : first + batch], dtype)
    return time.perf_counter() - started


def best_numpy_batch(u, dtype):
    """Return the batch size at which NumPy is fastest here."""
    sizes = [512, 1024, 2048, 4096, 8192, 16384, 32768]
    seconds = {
        size: min(numpy_round(u, dtype, size) for _ in range(3)) for size in sizes if size <= len(u)
    }
    return min(seconds, key=seconds.__getitem__)


def main():
    """Measure and print one line a side."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--simulations", type=int, default=131_072, help="a round")
    parser.add_argument("--batch", type=int, default=32_768, help="of the engine")
    options = parser.parse_args()
    n = options.simulations - options.simulations % options.batch

    problem = vj.Problem(
        "throughput",
        space={name: vj.Box(low, high) for name, (low, high) in RANGES.items()},
        system=cartpole.cartpole(controller=cartpole.linear(GAINS), duration=STEPS * PERIOD),
        spec=f"always[0, 4] (abs(x) <= {X_LIMIT} & abs(theta) <= {THETA_LIMIT!r})",
    )
    u = np.random.default_rng(0).random((n, 4), dtype=np.float32)
    key = run_keys(0)[1]
    engine = engine_for(problem, options.batch)
    engine.compile()

    rho = np.concatenate(
        [
            engine.evaluate(u[i : i + options.batch], key, i).rho[:, 0]
            for i in range(0, n, options.batch)
        ]
    )
    expected = numpy_robustness(u, np.float64)
    # Once fallen, a pole is chaotic and float32 goes its own way; the verdict is the same.
    agree = np.where(expected >= 0, np.abs(rho - expected) < 1e-3, rho < 0)
    assert np.mean(agree) > 0.999, f"the two sides disagree on {np.mean(~agree):.2%} of the rows"

    def engine_round():
        started = time.perf_counter()
        for first in range(0, n, options.batch):
            engine.evaluate(u[first : first + options.batch], key, first)
        return time.perf_counter() - started

    def loop_round(**settings):
        run = vj.falsify(problem, "uniform", n, progress=False, **settings)
        return run.run_seconds + run.confirm_seconds

    sides = {
        "engine": engine_round,
        "falsify(uniform)": loop_round,
        "without confirm": lambda: loop_round(confirm=False),
    }
    batches = {}
    for dtype in (np.float64, np.float32):
        batches[dtype] = batch = best_numpy_batch(u, dtype)
        name = f"numpy {dtype.__name__}"
        sides[name] = lambda dtype=dtype, batch=batch: numpy_round(u, dtype, batch)
    for side in sides.values():
        side()
    seconds = {name: [] for name in sides}
    for _ in range(options.rounds):
        for name, side in sides.items():
            seconds[name].append(side())

    device = jax.devices()[0]
    print(f"cart-pole, {STEPS} steps, 4 features, two-sided bounds; {n} simulations a round,")
    print(
        f"{options.rounds} rounds; {len(jax.devices())} x {device.platform}, jax {jax.__version__}"
        f", numpy {np.__version__}; failing {np.mean(rho < 0):.1%}"
    )
    for name, values in seconds.items():
        extra = "".join(f"  batch {b}" for d, b in batches.items() if name.endswith(d.__name__))
        if name == "engine":
            extra = f"  batch {options.batch}"
        print(f"  {name:<18}{n / statistics.median(values):>12,.0f} simulations/s{extra}")
    for side in ("engine", "falsify(uniform)", "without confirm"):
        for dtype in ("float64", "float32"):
            ratios = [b / a for a, b in zip(seconds[side], seconds[f"numpy {dtype}"], strict=True)]
            print(
                f"  {side} / numpy {dtype}: {statistics.median(ratios):.1f}x "
                f"(min {min(ratios):.1f}, max {max(ratios):.1f})"
            )
    print(
        f"  engine / VerifAI's 10 simulations/s: "
        f"{n / statistics.median(seconds['engine']) / 10:,.0f}x"
    )
    shares()


def shares():
    """Print how long the phases of a run take, with all defaults, on four problems."""
    print("uniform, 20 000 simulations, second run of the process:")
    for module, name in (
        ("specs.cartpole", "balance"),
        ("specs.lane_keeping", "ice"),
        ("specs.arch.automatic_transmission", "at1"),
        ("specs.arch.neural_network_controller", "nn"),
    ):
        problem = getattr(importlib.import_module(module), name)
        vj.falsify(problem, "uniform", 20_000, progress=False)
        run = vj.falsify(problem, "uniform", 20_000, seed=1, progress=False)
        counts = ", ".join(f"{count} {verdict}" for verdict, count in run.verdict_counts.items())
        print(
            f"  {name:<10}simulate {run.run_seconds:.2f} s, confirm {run.confirm_seconds:.2f} s: "
            f"{len(run.table.violating)} violate{f' ({counts})' if counts else ''}"
        )


if __name__ == "__main__":
    main()
