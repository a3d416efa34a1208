"""Native code beside XLA's, on the same rows: simulations, gradients, and whole runs.

    python benchmarks/native.py                         # all systems
    python benchmarks/native.py cartpole at1            # some of them

Rounds alternate between the sides, and a ratio is the median of the ratios of neighbouring rounds.
Next to the speed by the clock stands the ratio of processor seconds, which other programs on the
machine disturb least. The cart-pole is also written by hand in C (`cartpole.c`).
"""

import argparse
import ctypes
import importlib
import itertools
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from throughput import GAINS, PERIOD, RANGES, STEPS, THETA_LIMIT, X_LIMIT

import verifai_jax as vj
from envs import cartpole
from verifai_jax.addons.native.native_engine import FIRST, NativeEngine
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.evaluation.engine import engine_for

KEY = run_keys(0)[1]
HERE = Path(__file__).parent


def cart_pole():
    return vj.Problem(
        "throughput",
        space={name: vj.Box(low, high) for name, (low, high) in RANGES.items()},
        system=cartpole.cartpole(controller=cartpole.linear(GAINS), duration=STEPS * PERIOD),
        spec=f"always[0, 4] (abs(x) <= {X_LIMIT} & abs(theta) <= {THETA_LIMIT!r})",
    )


def quadrotor():
    """Return the problem of docs/own_equations.md."""
    text = (HERE.parent / "docs" / "own_equations.md").read_text()
    names = {}
    exec(text.split("```python\n")[1].split("run = ")[0], names)
    return names["problem"]


WIDTH = 64


def wide():
    """Return a cart-pole whose policy has two hidden layers of `WIDTH` units."""
    rng, sizes = np.random.default_rng(0), (4, WIDTH, WIDTH, 2)
    layers = tuple(
        (rng.normal(size=(a, b)).astype(np.float32) / a**0.5, np.full(b, 0.1, np.float32))
        for a, b in itertools.pairwise(sizes)
    )
    policy = vj.rl.Policy(layers, None, None, None, vj.rl.Discrete(2))
    return vj.Problem(
        "wide",
        space={name: vj.Box(low, high) for name, (low, high) in RANGES.items()},
        system=cartpole.cartpole(controller=cartpole.neural(policy), duration=STEPS * PERIOD),
        spec=f"always[0, 4] abs(theta) <= {THETA_LIMIT!r}",
    )


SYSTEMS = {
    "wide": (wide, 4096),
    "cartpole": (cart_pole, 32768),
    "quadrotor": (quadrotor, 8192),
    "balance": ("specs.cartpole", 8192),
    "ice": ("specs.lane_keeping", 8192),
    "open_loop": ("specs.sway", 8192),
    "at1": ("specs.arch.automatic_transmission", 2048),
    "sc": ("specs.arch.steam_condenser", 1024),
    "cc1": ("specs.arch.chasing_cars", 1024),
}
GRADIENT_ROWS = 256


def problem_of(name):
    made = SYSTEMS[name][0]
    found = made() if callable(made) else getattr(importlib.import_module(made), name)
    return found() if callable(found) else found


def timed(call):
    wall, cpu = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - wall, time.process_time() - cpu


def compared(problem, batch, rounds, gradient):
    """Print the speed of both engines, the ratio by both clocks, and how far they agree."""
    u = np.random.default_rng(0).random((batch, problem.space.dim), np.float32)
    xla = engine_for(problem, batch, gradient)
    native = NativeEngine(xla, "native", batch)
    began = time.perf_counter()
    native.evaluate(u, KEY, FIRST, 0.1)
    began = time.perf_counter() - began
    if native.notes:
        print(f"  {native.notes[-1]}")
        return
    ours, theirs = native.evaluate(u, KEY, FIRST, 0.1), xla.evaluate(u, KEY, FIRST, 0.1)
    sides = (lambda: native.evaluate(u, KEY, FIRST, 0.1), lambda: xla.evaluate(u, KEY, FIRST, 0.1))
    times = [(timed(sides[0]), timed(sides[1])) for _ in range(rounds)]
    speeds = [batch / statistics.median(each[i][0] for each in times) for i in (0, 1)]
    ratios = [statistics.median(b[i] / a[i] for a, b in times) for i in (0, 1)]
    what = "gradient" if gradient else "forward"
    same = np.mean(ours.violated == theirs.violated)
    far = np.nanquantile(np.abs(ours.rho - theirs.rho), 0.999)
    more = ""
    if gradient:
        mine, other = np.asarray(ours.gradient), np.asarray(theirs.gradient)
        size = np.abs(other).max(1, keepdims=True) + 1e-6
        far_off = np.nanquantile(np.abs(mine - other) / size, 0.99)
        more = f", gradients within {far_off:z.0e} in 99 %"
    print(
        f"  {what:<9}native {speeds[0]:>11,.0f}/s  xla {speeds[1]:>11,.0f}/s  "
        f"{ratios[0]:z.1f}x ({ratios[1]:z.1f}x in processor time)  begun in {began:z.1f} s; "
        f"verdicts {same:z.4%}, 99.9 % within {far:z.0e}{more}",
        flush=True,
    )


def by_hand(rounds, n=1_048_576):
    """Compare the cart-pole's native engine, and whole runs, with C that is written by hand.

    The time of a run by the clock is that of its rounds; its processor time is that of the whole
    call, which also looks for the files of the model and prepares its programs.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "cartpole.so"
        flags = ["-O3", "-march=native", "-ffast-math", "-fopenmp", "-shared", "-fPIC"]
        subprocess.run(["cc", *flags, HERE / "cartpole.c", "-o", file, "-lm"], check=True)
        hand = ctypes.CDLL(str(file))
    hand.robustness.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_long]
    problem, batch = cart_pole(), 32768
    u, out = np.random.default_rng(0).random((n, 4), np.float32), np.empty(n, np.float32)
    native = NativeEngine(engine_for(problem, batch), "native", n)

    def engine():
        for i in range(0, n, batch):
            native.evaluate(u[i : i + batch], KEY, FIRST + i)

    def run(**options):
        cpu = time.process_time()
        done = vj.falsify(problem, "uniform", n, progress=False, **options)
        return done.run_seconds + done.confirm_seconds, time.process_time() - cpu

    c = lambda: hand.robustness(u.ctypes.data, out.ctypes.data, n)  # noqa: E731
    sides = {
        "native engine": lambda: timed(engine),
        "falsify(uniform)": run,
        "falsify(uniform), confirm=False": lambda: run(confirm=False),
        "falsify(uniform), engine='xla'": lambda: run(run_on=vj.RunOn(engine="xla")),
    }
    c()
    for side in sides.values():
        side()
    rows = [(timed(c), *(side() for side in sides.values())) for _ in range(rounds)]
    print(f"cart-pole by hand in C: {n / statistics.median(row[0][0] for row in rows):,.0f}/s")
    for i, name in enumerate(sides, 1):
        shares = [statistics.median(row[0][k] / row[i][k] for row in rows) for k in (0, 1)]
        speed = n / statistics.median(row[i][0] for row in rows)
        print(
            f"  {name:<32}{speed:>11,.0f}/s  {shares[0]:z.2f} of C "
            f"({shares[1]:z.2f} by processor time)",
            flush=True,
        )


def beside_blas(rounds, batch=4096):
    """Compare the products of a policy in the loop with the same products alone, by NumPy's BLAS.

    By processor time, of all that a simulation takes; run with OPENBLAS_NUM_THREADS=1, since idle
    threads of BLAS take time too.
    """
    rng = np.random.default_rng(0)
    native = NativeEngine(engine_for(wide(), batch), "native", batch)
    u, hidden = rng.random((batch, 4), np.float32), rng.random((batch, WIDTH), np.float32)
    weights, out = rng.random((WIDTH, WIDTH), np.float32), np.empty((batch, WIDTH), np.float32)

    def alone():
        for _ in range(STEPS):
            np.matmul(hidden, weights, out=out)

    sides = (lambda: native.evaluate(u, KEY, FIRST), alone)
    products = (WIDTH * (WIDTH + 6), WIDTH * WIDTH)
    for side in sides:
        side()
    rows = [
        [timed(side)[1] / n for side, n in zip(sides, products, strict=True)] for _ in range(rounds)
    ]
    share = statistics.median(blas / ours for ours, blas in rows)
    print(f"policy of 2 x {WIDTH} in the loop: {share:z.2f} of BLAS alone")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("systems", nargs="*", choices=[*SYSTEMS, []], help="all when left out")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--rows", type=int, default=1_048_576, help="of the cart-pole by hand")
    options = parser.parse_args()
    by_hand(options.rounds, options.rows)
    beside_blas(options.rounds)
    for name in options.systems or SYSTEMS:
        print(name)
        problem = problem_of(name)
        compared(problem, SYSTEMS[name][1], options.rounds, gradient=False)
        compared(problem, GRADIENT_ROWS, options.rounds, gradient=True)
