"""Time to a first result, whole processes: from the shell to the end, beside the code before.

    python benchmarks/first_result.py --before ../checkout-of-before [--pairs 3] [--cases cold,help]

Each case is run in turn with both checkouts, in processes of their own, and the order of a pair
changes from pair to pair. Processor time (user and system, all threads, from the operating system)
is what a busy machine disturbs least; beside it are the time by the clock and that to the first
line that the process prints, which says what was found, before pictures. The ratio is the median of
those of the pairs.

| case | what runs |
|---|---|
| `cold` | a planar quadrotor by `vj.ode`, default search and budget, no compiled program on disk |
| `again` | the same in a new process |
| `bound` | the same after an edit of a bound of its wind |
| `budget` | the same after an edit of the budget, 10 000 to 9000 |
| `small` | a quadrotor of four states at one height, four numbers as features, nothing compiled |
| `at1` | `verifai-jax falsify` of ARCH AT1 to its first confirmed counterexample, the second time |
| `falsify` | what `make falsify` runs, with its pictures, the second time |
| `brax` | ten rows of a Brax hopper, simulated and confirmed by `vj.confirm`, no program on disk |
| `confirm` | a process that loads these ten rows, simulated before, and confirms them, likewise |
| `help`, `import` | `verifai-jax --help`; `import verifai_jax` and `verifai_jax.Box` |
| `list` | `verifai-jax list`, the problems of `specs/`, the second time |
"""

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

CASES = (
    "cold", "again", "bound", "budget", "small", "at1", "falsify", "brax", "confirm", "list",
    "help", "import",
)  # fmt: skip
AT1 = "specs/arch/automatic_transmission.py:at1"
COMMAND = "import sys; from verifai_jax.cli.main import main; sys.argv[0] = 'verifai-jax'; main()"


def quadrotor(gust):
    """Return the problem of a quadrotor in a plane that is to hover in gusts."""
    import jax.numpy as jnp

    import verifai_jax as vj

    def motion(time, state, control, features):
        thrust, torque = control["thrust"], control["torque"]
        drag = 0.3 * (features["wind"](time) - state["vx"])
        return {
            "x": state["vx"],
            "z": state["vz"],
            "theta": state["omega"],
            "vx": (drag - thrust * jnp.sin(state["theta"])) / features["mass"],
            "vz": (thrust * jnp.cos(state["theta"]) - 0.3 * state["vz"]) / features["mass"] - 9.81,
            "omega": torque / features["inertia"],
        }

    def hover(time, state, features):
        lean = jnp.clip((state["x"] + 1.6 * state["vx"]) / 9.81, -0.5, 0.5)
        lift = 9.81 + 6.0 * (1.0 - state["z"]) - 4.0 * state["vz"]
        turn = 0.02 * (40.0 * (lean - state["theta"]) - 9.0 * state["omega"])
        return {"thrust": jnp.clip(0.5 * lift, 0.0, 12.0), "torque": jnp.clip(turn, -0.2, 0.2)}

    def start(features, key):
        still = {"z": 1.0, "vx": 0.0, "vz": 0.0, "omega": 0.0}
        return {"x": features["x0"], "theta": features["theta0"], **still}

    space = {
        "x0": vj.Box(-1.0, 1.0),
        "theta0": vj.Box(-0.6, 0.6),
        "mass": vj.Box(0.4, 0.8),
        "inertia": vj.Box(0.01, 0.03),
        "wind": vj.Signal(vj.Box(-gust, gust), knots=5, hold="linear"),
    }
    spec = {
        "stays": "always abs(x) < 2.5",
        "high": "always z > 0.3",
        "calm": "eventually[0, 4] always[0, 1] abs(theta) < 0.3",
    }
    system = vj.ode(motion, start, controller=hover, dt=0.01, duration=5.0)
    nominal = {"x0": 0.0, "theta0": 0.0, "mass": 0.5, "inertia": 0.02, "wind": 0.0}
    return vj.Problem("hover", space, system, spec, nominal=nominal)


def small_quadrotor():
    """Return the problem of a quadrotor that is held at one height and is to stay in place."""
    import jax.numpy as jnp

    import verifai_jax as vj

    def motion(time, state, torque, features):
        drag = 0.3 * (features["wind"] - state["vx"])
        return {
            "x": state["vx"],
            "vx": drag / features["mass"] - 9.81 * jnp.tan(state["theta"]),
            "theta": state["omega"],
            "omega": torque / 0.02,
        }

    def hover(time, state, features):
        lean = jnp.clip((state["x"] + 1.6 * state["vx"]) / 9.81, -0.5, 0.5)
        turn = 0.02 * (40.0 * (lean - state["theta"]) - 9.0 * state["omega"])
        return jnp.clip(turn, -0.2, 0.2)

    def start(features, key):
        return {"x": features["x0"], "vx": 0.0, "theta": features["theta0"], "omega": 0.0}

    space = {
        "x0": vj.Box(-1.0, 1.0),
        "theta0": vj.Box(-0.6, 0.6),
        "mass": vj.Box(0.4, 0.8),
        "wind": vj.Box(-3.0, 3.0),
    }
    system = vj.ode(motion, start, controller=hover, dt=0.01, duration=5.0)
    return vj.Problem("hover", space, system, "always abs(x) < 2.2")


def run_quadrotor(problem, budget):
    """Falsify it and print what came of it."""
    import verifai_jax as vj

    run = vj.falsify(problem, budget=budget, progress=False)
    lowest = run.table.all["rho"].min()
    print(f"{len(run.table.counterexamples)} of {len(run.table)}, {lowest:.9g}")


def hopper():
    """Return the problem of a hopper of Brax that fails wherever it begins."""
    import jax.numpy as jnp

    import verifai_jax as vj

    system = vj.brax(
        "hopper",
        lambda observation: 0.5 * jnp.tanh(observation[:3]),
        backend="generalized",
        steps=50,
        signals={"height": 0},
        initial={"x": "q[0]"},
        exact_step=False,
    )
    return vj.Problem("hopper", {"x": vj.Box(0.0, 0.1)}, system, "always height > 5")


def run_brax(action, folder=None):
    """Simulate ten rows of a hopper, confirm them and print how many are, or either of these."""
    import verifai_jax as vj

    problem = hopper()
    if action == "confirm":
        run = vj.load(folder, problem)
    else:
        run = vj.falsify(
            problem, "uniform", budget=10, confirm=False, progress=False, folder=folder
        )
    if action != "simulate":
        print(vj.confirm(run).counts)


def measure(command, checkout, cache):
    """Return processor seconds and seconds of a process, those to its first line, and its lines."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "VERIFAI_JAX_CACHE": str(cache)}
    started = time.perf_counter()
    process = subprocess.Popen(command, cwd=checkout, env=environment, stdout=subprocess.PIPE)
    assert process.stdout is not None
    first = process.stdout.readline()
    answered = time.perf_counter() - started
    said = (first + process.stdout.read()).decode()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    seconds = time.perf_counter() - started
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} failed in {checkout}")
    return usage.ru_utime + usage.ru_stime, seconds, answered, said


def command_of(case, path):
    """Return the command of a case; `path` is an empty folder."""
    python = sys.executable
    if case in ("cold", "again", "bound", "budget"):
        gust, budget = 2.1 if case == "bound" else 2.0, 9000 if case == "budget" else 10_000
        return [python, __file__, "--quadrotor", str(gust), str(budget)]
    if case == "small":
        return [python, __file__, "--small"]
    if case == "brax":
        return [python, __file__, "--brax", "both"]
    if case in ("simulate", "confirm"):
        return [python, __file__, "--brax", case, str(path / "run")]
    if case == "list":
        return [python, "-c", COMMAND, "list"]
    if case == "import":
        return [python, "-c", "import verifai_jax; verifai_jax.Box"]
    if case == "help":
        return [python, "-c", COMMAND, "--help"]
    folder = ["--folder", str(path / "run"), "--no-progress"]
    if case == "at1":
        return [python, "-c", COMMAND, "falsify", AT1, "--stop-after", "1", *folder]
    target = ["specs/cartpole.py:balance", "--search", "uniform", "--budget", "20000"]
    return [python, "-c", COMMAND, "falsify", *target, *folder]


def one(case, checkout, caches):
    """Run a case once and return what `measure` does."""
    # One place for all: JAX knows a compiled program by the folder of its cache, too.
    cache = caches / checkout.name / "compiled"
    if case not in ("cold", "small", "brax", "confirm", "help", "import"):
        fill(case, checkout, caches, cache)
    else:
        shutil.rmtree(cache, ignore_errors=True)
    with tempfile.TemporaryDirectory() as path:
        if case == "confirm":
            measure(command_of("simulate", Path(path)), checkout, cache)
            shutil.rmtree(cache)
        result = measure(command_of(case, Path(path)), checkout, cache)
    if case == "cold":
        shutil.copytree(cache, kept(case, checkout, caches), dirs_exist_ok=True)
    return result


def fill(case, checkout, caches, cache):
    """Put what an earlier process has compiled into the cache; for an edit, before the edit."""
    earlier = kept(case, checkout, caches)
    shutil.rmtree(cache, ignore_errors=True)
    if not earlier.exists():
        with tempfile.TemporaryDirectory() as path:
            before = "cold" if case in ("again", "bound", "budget") else case
            measure(command_of(before, Path(path)), checkout, cache)
        cache.mkdir(parents=True, exist_ok=True)  # Some compile nothing that is kept.
        shutil.copytree(cache, earlier)
    else:
        shutil.copytree(earlier, cache)


def kept(case, checkout, caches):
    """Return where the cache is kept that this case begins with, or leaves if it is cold."""
    name = "quadrotor" if case in ("cold", "again", "bound", "budget") else case
    return caches / checkout.name / name


def main():
    """Measure pairs and print one line a case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--before", type=Path, help="a checkout of the code before")
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--quadrotor", nargs=2, type=float, help=argparse.SUPPRESS)
    parser.add_argument("--brax", nargs="+", help=argparse.SUPPRESS)
    parser.add_argument("--small", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.brax:
        run_brax(*options.brax)
        return
    if options.small:
        run_quadrotor(small_quadrotor(), 10_000)
        return
    if options.quadrotor:
        run_quadrotor(quadrotor(options.quadrotor[0]), int(options.quadrotor[1]))
        return
    now = Path(__file__).resolve().parents[1]
    checkouts = [now] if options.before is None else [options.before.resolve(), now]
    head = "processor s (s by the clock, s to its first line)"
    print(f"{'case':<10}{'before':>20}{'now':>20}{'ratio':>8}   {head}")
    with tempfile.TemporaryDirectory() as caches:
        for case in options.cases.split(","):
            rows = {checkout: [] for checkout in checkouts}
            for pair in range(options.pairs):
                for checkout in checkouts if pair % 2 else checkouts[::-1]:
                    rows[checkout].append(one(case, checkout, Path(caches)))
            if case in ("cold", "again", "bound", "budget", "small"):
                # The same each time; both checkouts need not search alike.
                found = [{run[-1].strip() for run in runs} for runs in rows.values()]
                assert all(len(each) == 1 for each in found), found
                print(f"# {case}: {' | '.join(each.pop() for each in found)}")
            shown = [
                f"{statistics.median(r[0] for r in runs):.2f} "
                f"({statistics.median(r[1] for r in runs):.1f}, "
                f"{statistics.median(r[2] for r in runs):.1f})"
                for runs in rows.values()
            ]
            ratio = ""
            if len(checkouts) == 2:
                pairs = zip(rows[now], rows[checkouts[0]], strict=True)
                ratio = f"{statistics.median(a[0] / b[0] for a, b in pairs):.2f}"
            before = shown[0] if len(checkouts) == 2 else ""
            print(f"{case:<10}{before:>20}{shown[-1]:>20}{ratio:>8}", flush=True)


if __name__ == "__main__":
    main()
