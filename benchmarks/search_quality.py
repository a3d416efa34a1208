"""Simulations until the first failure, search by search: on known landscapes, and on a controller.

    python benchmarks/search_quality.py landscapes [--seeds 24] [--searches bayes,bandit]
    python benchmarks/search_quality.py cartpole [--seeds 20] [--problem rare]
    python benchmarks/search_quality.py kinds [--seeds 10]
    VERIFAI_JAX_CACHE=off python benchmarks/search_quality.py constants [--seeds 10]
    python benchmarks/search_quality.py table [--seeds 10] [--problems ball tanks] [--libraries]

What counts is the number of the simulation that found the first failure. On the landscapes the
share of failures is known, and with it what uniform sampling needs in the median, log(2) / share;
a search's entry is how many times fewer it needs. On the controller the failure rate is measured
first. A simulation with a derivative counts as one; the row `gradient (as 2)` counts it as two.

`table` compares searches on thirty small problems (`small_problems`), and nine that no search was
tuned on (`held_out_problems`), one line a problem: the
median cost of the first failure in rounds of 16, a differentiated simulation as two, and the seeds
that found one if not all did. With `--libraries` the packages cmaes and Optuna (TPE) stand beside
them, where they are installed.

`constants` changes each number of the default search in turn: the median cost on some of the small
problems, and the geometric mean of its ratios to that with the numbers as they are.

`kinds` counts how many of eight wells the default search has failures in after 3000 simulations,
with each number that decides about that changed in turn.
"""

import argparse
import math
import statistics
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from landscapes import LANDSCAPES, tell_of

import verifai_jax as vj
from benchmarks.seeds import first_failures
from verifai_jax.core.user_code.targets import load_target
from verifai_jax.core.values.cube import Cube
from verifai_jax.search import kinds, portfolio, surrogate
from verifai_jax.search.search_program import compiled_search

BATCH = {"uniform": 512, "halton": 512, "gradient": 8, "bayes": 8}
ACTIVE_BATCH = 16
PASSIVE = ("uniform", "halton")
# Without scrambling the sequence is the same for all seeds.
OPTIONS = {"halton": {"scramble": True}}
# A grid's result depends on how it lies to the failures, and the predecessor's one-sample rule
# learns from failures alone: neither has a figure that would say something here.
LEFT_OUT = ("grid",)
MAX_SIMULATIONS = (
    12_288  # Simulations of one seed; one without a failure by then counts as infinite.
)
SIMULATIONS_A_CALL = 256


def searches(chosen):
    """Name -> (search, batch), for the names given or for all."""
    names = chosen.split(",") if chosen else [n for n in vj.search.names() if n not in LEFT_OUT]
    return {
        name: (
            vj.search.named(name, **OPTIONS.get(name, {})),
            BATCH.get(name, ACTIVE_BATCH),
        )
        for name in names
    }


@partial(jax.jit, static_argnums=(0, 1, 2, 3, 4))
def advance(search, rho, cube, batch, rounds, state):
    """Some rounds of every seed's search.

    **Returns:** the states; the robustness `[seeds, rounds * batch]`, what each simulation counts
    with a derivative as two, 0 where a search that plans its rounds left a row out; and the points.
    """

    def step(state, _):
        u, state = search.ask(state, cube, batch)
        value, gradient = jax.vmap(jax.value_and_grad(rho))(u)
        observations = tell_of(search, state, cube, u, value, gradient)
        differentiates = search.wants.gradient
        if search.wants.clauses:
            differentiates = search.plan(state, cube, batch).differentiate
        cost = jnp.where(observations.valid, jnp.where(differentiates, 2, 1), 0)
        value = jnp.where(cost > 0, value, jnp.inf)
        return search.tell(state, cube, observations), (value, cost, u)

    def one(state):
        state, (values, costs, u) = jax.lax.scan(step, state, None, length=rounds)
        return state, values.ravel(), costs.ravel(), u.reshape(-1, cube.dim)

    return jax.vmap(one)(state)


def first_on_landscape(search, landscape, batch, seeds):
    """Number of the first failing simulation of each seed, counted from 1; infinite without one.

    **Returns:** that, and the same with a derivative counted as a simulation more.
    """
    rho, cube, _ = landscape
    keys = jax.random.split(jax.random.key(2024), seeds)
    state = jax.vmap(lambda key: search.init(key, cube, batch))(keys)
    rounds = max(1, SIMULATIONS_A_CALL // batch)
    first, doubled = np.full(seeds, np.inf), np.full(seeds, np.inf)
    done, spent = np.zeros(seeds), np.zeros(seeds)
    while done.min() < MAX_SIMULATIONS and np.isinf(first).sum() > (seeds - 1) // 2:
        state, values, costs, _ = advance(search, rho, cube, batch, rounds, state)
        failing, costs = np.asarray(values) < 0, np.asarray(costs)
        number = done[:, None] + np.cumsum(costs > 0, axis=1)
        price = spent[:, None] + np.cumsum(costs, axis=1)
        found = failing.any(axis=1) & np.isinf(first)
        index = failing.argmax(axis=1)[found]
        first[found], doubled[found] = number[found, index], price[found, index]
        done, spent = number[:, -1], price[:, -1]
    return first, doubled


def on_landscapes(options):
    """Print a line a search: how many times fewer simulations than uniform sampling it needs."""
    chosen = options.landscapes.split(",") if options.landscapes else list(LANDSCAPES)
    print(f"{options.seeds} seeds; median simulations to the first failure, and uniform / it")
    print(f"{'':<19}" + "".join(f"{name:>16}" for name in chosen))
    expected = {name: math.log(2) / LANDSCAPES[name].share for name in chosen}
    print(f"{'uniform, log 2 / p':<19}" + "".join(f"{expected[n]:>16.0f}" for n in chosen))
    for name, (search, batch) in searches(options.searches).items():
        started, cells, doubled = time.perf_counter(), [], []
        for landscape in chosen:
            counts = first_on_landscape(search, LANDSCAPES[landscape], batch, options.seeds)
            for median, row in zip(map(np.median, counts), (cells, doubled), strict=True):
                row.append(f"{median:>8.0f} {expected[landscape] / median:>6.1f}x")
        seconds = time.perf_counter() - started
        print(f"{name:<19}" + "".join(cells) + f"   batch {batch}, {seconds:.0f} s", flush=True)
        if search.wants.gradient or search.wants.clauses:
            print(f"{name + ' (as 2)':<19}" + "".join(doubled), flush=True)


def first_failure(problem, search, batch, seed, budget):
    """Number of the first failing simulation of a run; the budget where there is none."""
    run = vj.falsify(
        problem, search, budget, batch=batch, seed=seed, stop=vj.Stop(after=1), progress=False
    )
    failing = np.flatnonzero(run.table.all["violated"])
    return (int(failing[0]) + 1, True) if len(failing) else (budget, False)


def median_cost(problem, search, batch, options):
    """Median of what the first failure costs, a derivative as a simulation more."""
    cost = first_failures(problem, search, options.budget, batch, range(options.seeds)).cost
    return statistics.median(np.where(np.isfinite(cost), cost, options.budget).tolist())


def on_cartpole(options):
    """One line a search on a problem of specs/cartpole.py."""
    problem = load_target(f"specs/cartpole.py:{options.problem}", vj.Problem)
    rate = vj.falsify(problem, "uniform", 200_000, batch=8192, seed=999, progress=False)
    print(f"{problem}\n  failure rate {rate.failure_rate}")
    print(
        f"{'search':<17}{'batch':>6}{'found':>8}{'median':>9}{'quartiles':>16}"
        f"{'uniform /':>11}{'gradient as 2':>15}{'seconds':>9}"
    )
    uniform = None
    for name, (search, batch) in searches(options.searches).items():
        started = time.perf_counter()
        results = [
            first_failure(problem, search, batch, seed, options.budget)
            for seed in range(options.seeds)
        ]
        seconds = time.perf_counter() - started
        counts = [count for count, _ in results]
        median = statistics.median(counts)
        uniform = uniform or median
        low, high = np.percentile(counts, [25, 75])
        doubled = ""
        if search.wants.gradient:
            doubled = f"{uniform / (2 * median):.1f}x"
        elif search.wants.clauses:
            doubled = f"{uniform / median_cost(problem, search, batch, options):.1f}x"
        print(
            f"{name:<17}{batch:>6}{sum(f for _, f in results):>5}/{options.seeds}"
            f"{median:>9.0f}{f'{low:.0f} - {high:.0f}':>16}{uniform / median:>10.1f}x"
            f"{doubled:>15}{seconds:>9.1f}",
            flush=True,
        )


WELLS = {4: 0.1, 6: 0.22}
"""Radius of each of eight wells by dimension; together they are 0.4 % and 0.5 % of the cube."""
PATIENCE = ((portfolio, "LESS_PATIENT", (1, 2, 4)),)
NUMBERS = (
    (kinds, "ENOUGH", (10, 5, 20)),
    (kinds, "REACH", (0.05, 0.025, 0.1)),
    (kinds, "TAPER", (0.15, 0.075, 0.3)),
)
"""Numbers of the default search, the chosen one first."""


def wells(d):
    """Eight wells far from each other, whose walls are up to twice as steep as the first's."""
    rng, centres = np.random.default_rng(d), []
    while len(centres) < 8:
        point = rng.uniform(0.08, 0.92, d)
        if all(np.linalg.norm(point - other) > 2.5 * WELLS[d] for other in centres):
            centres.append(point)
    centres, slopes = np.array(centres, np.float32), np.linspace(1, 2, 8, dtype=np.float32)

    def rho(u):
        far = jnp.sqrt(jnp.sum((u - centres) ** 2, axis=1) + 1e-9)
        return jnp.min(slopes * (far - WELLS[d]))

    def found(u):
        far = np.linalg.norm(u[:, None] - centres, axis=2)
        return len(set(far.argmin(axis=1)[far.min(axis=1) < WELLS[d]]))

    return rho, found


def kinds_of_runs(d, seeds, **options):
    """Return how many wells each seed has failures in, and its number of failures."""
    rho, found = wells(d)
    space = {"u": vj.Box([0.0] * d, [1.0] * d)}
    problem = vj.Problem(
        "wells", space, lambda f, key: vj.Trace({"out": rho(f["u"])[None]}, dt=0.1),
        "always out > 0",
    )  # fmt: skip
    cells = []
    for seed in range(seeds):
        search = vj.search.Portfolio(**options)
        run = vj.falsify(problem, search, 3000, seed=seed, confirm=False, progress=False)
        rows = run.table.violating
        cells.append((found(problem.space.points(rows)), len(rows)))
    return np.array(cells)


def on_kinds(options):
    """One line a number: wells found in whole runs, and without gradients in rounds of 128."""
    for name, value in (("kinds", False), ("kinds", True)):
        for d in WELLS:
            cells = kinds_of_runs(d, options.seeds, kinds=value)
            print(
                f"{name}={value}, {d} dimensions: {cells[:, 0]}, failures {np.median(cells[:, 1])}"
            )
    for module, name, values in PATIENCE:
        for value in values:
            setattr(module, name, value)
            found = [np.sort(kinds_of_runs(d, options.seeds)[:, 0]) for d in WELLS]
            print(f"{name} {value}: median {[float(np.median(f)) for f in found]}, "
                  f"mean {[float(np.mean(f)) for f in found]}", flush=True)  # fmt: skip
        setattr(module, name, values[0])
    search = vj.search.Portfolio(gradients=False)
    for module, name, values in NUMBERS:
        for value in values:
            setattr(module, name, value)
            jax.clear_caches()
            medians = []
            for d in WELLS:
                (rho, found), cube = wells(d), Cube((0,) * d)
                keys = jax.random.split(jax.random.key(7), options.seeds)
                state = jax.vmap(lambda key, cube=cube: search.init(key, cube, 128))(keys)
                _, rows, _, u = advance(search, rho, cube, 128, 3000 // 128, state)
                counts = [found(np.asarray(u[i][rows[i] < 0])) for i in range(options.seeds)]
                medians.append((float(np.median(counts)), float(np.mean(counts))))
            print(f"{name} {value}: median and mean {medians}", flush=True)
        setattr(module, name, values[0])


def by_cmaes(d, seed):
    """Return `ask` and `tell` of the package cmaes on a cube of `d` dimensions."""
    import cmaes

    def begun(mean):
        bounds = np.tile([0.0, 1.0], (d, 1))
        return cmaes.CMA(mean=mean, sigma=0.3, bounds=bounds, seed=seed, population_size=16)

    held = [begun(np.full(d, 0.5))]

    def tell(points, values):
        held[0].tell(list(zip(points, values, strict=True)))
        if held[0].should_stop():
            held[0] = begun(np.random.default_rng(int(1e6 * values[0]) % 2**31).uniform(size=d))

    return (lambda: np.array([held[0].ask() for _ in range(ACTIVE_BATCH)])), tell


def by_optuna(d, seed):
    """Return `ask` and `tell` of Optuna's TPE on a cube of `d` dimensions."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed, multivariate=True))
    floats = {f"u{i}": optuna.distributions.FloatDistribution(0, 1) for i in range(d)}
    asked = []

    def ask():
        asked.append(study.ask(floats))
        return np.array([[asked[-1].params[name] for name in floats]])

    return ask, lambda points, values: study.tell(asked[-1], float(values[0]))


LIBRARIES = {"cmaes (library)": by_cmaes, "TPE (library)": by_optuna}


def first_of_library(problem, library, budget, seeds):
    """Return the number of the first failure of each seed; infinite without one."""
    rho = jax.jit(jax.vmap(problem.objective()))
    found = np.full(seeds, np.inf)
    for seed in range(seeds):
        (ask, tell), done = LIBRARIES[library](problem.space.dim, seed), 0
        while done < budget and np.isinf(found[seed]):
            points = ask()
            values = np.asarray(rho(np.asarray(points, np.float32)))
            if (values < 0).any():
                found[seed] = done + 1 + int((values < 0).argmax())
            tell(points, values)
            done += len(points)
    return found


def on_small(options):
    """One line a problem: every search."""
    from held_out_problems import HELD_OUT
    from small_problems import SMALL

    problems = SMALL | HELD_OUT
    names = options.searches.split(",") if options.searches else list(vj.search.names())
    libraries = list(LIBRARIES) if options.libraries else []
    print("| problem | " + " | ".join(names + libraries) + " |")
    for name in options.problems or problems:
        cells, problem = [name], problems[name]
        for search in names + libraries:
            try:
                if search in LIBRARIES:
                    costs = first_of_library(problem, search, options.budget, options.seeds)
                else:
                    costs = first_failures(
                        problem, search, options.budget, ACTIVE_BATCH, range(options.seeds)
                    ).cost
            except ValueError:  # It needs a continuous feature.
                cells.append("-")
                continue
            found = int(np.isfinite(costs).sum())
            median = np.median(np.where(np.isfinite(costs), costs, np.inf))
            short = "" if found == options.seeds else f" ({found})"
            cells.append(f"{median:.0f}{short}")
        print("| " + " | ".join(cells) + " |", flush=True)


VARIED = ("ridge", "ripples", "mixed", "levers", "recipe", "decoy", "tanks", "shuttle", "cruise")
CONSTANTS = {
    "PRIOR_GAINS": ((2.0, 2.5), (8.0, 2.5)),
    "PRIOR_COSTS": (2.0, 8.0),
    "DISCOUNT": (0.95, 0.99),
    "MIN_SHARE": (0.02, 0.1),
    "IN_VAIN": ((3, 3), (3, 12)),
    "OPENING": (4, 12),
    "OPENING_ROWS": (10, 40),
    "MODELLED": (0.6, 0.95),
    "AMONG": (2, 8),
    "TAKEN": (8,),
}
"""Other values of the numbers of the default search."""
OF_MODELS = {
    "CAPACITY": (64, 256),
    "ENOUGH": (4, 16),
    "EVENLY": (0.05, 0.2),
    "PATIENCE": (40, 160),
    "ADDITIVE": ((0.25, 0.25), (0.5, 0.5)),
    "ALONG": ((0.5, 1.5, 5.0), (2.0, 6.0, 20.0)),
    "ELITE": (16, 64),
    "STEPS": ((0.05, 2.0), (0.5, 3.0)),
    "GROUPS": (1, 4, 16),
}
"""And of its models."""


def on_constants(options):
    """One line a value of a number of the default search."""
    from small_problems import SMALL

    def medians():
        compiled_search.cache_clear()  # The programs know the numbers by their values alone.
        costs = [
            first_failures(SMALL[name], "portfolio", 1000, ACTIVE_BATCH, range(options.seeds)).cost
            for name in options.problems or VARIED
        ]
        return np.array([np.median(np.minimum(cost, 1200)) for cost in costs])

    usual = medians()
    print("as they are", usual, flush=True)
    numbers = [(portfolio, name, values) for name, values in CONSTANTS.items()]
    numbers += [(surrogate, name, values) for name, values in OF_MODELS.items()]
    for module, name, values in numbers:
        chosen = getattr(module, name)
        for value in values:
            setattr(module, name, value)
            found = medians()
            ratio = np.exp(np.mean(np.log(found / usual)))
            print(f"{name} {value} instead of {chosen}: {ratio:.2f}", found, flush=True)
        setattr(module, name, chosen)


CASES = {
    "landscapes": on_landscapes,
    "cartpole": on_cartpole,
    "kinds": on_kinds,
    "table": on_small,
    "constants": on_constants,
}


def main():
    """Measure and print one line a search."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("where", choices=list(CASES))
    parser.add_argument("--seeds", type=int, default=24)
    parser.add_argument("--searches", default="", help="names, comma-separated")
    parser.add_argument("--landscapes", default="", help="names, comma-separated")
    parser.add_argument("--budget", type=int, default=10_000)
    parser.add_argument("--problem", default="rare", help="name of a problem in specs/cartpole.py")
    parser.add_argument("--problems", nargs="*", help="names of small problems")
    parser.add_argument("--libraries", action="store_true", help="also cmaes and Optuna's TPE")
    options = parser.parse_args()
    CASES[options.where](options)


if __name__ == "__main__":
    main()
