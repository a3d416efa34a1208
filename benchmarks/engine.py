"""The engine on real dynamics: speed, overhead, gradients, compile time.

    python benchmarks/engine.py speed                   # physics steps/s, batch 1 to 4096
    python benchmarks/engine.py overhead                # over a bare jitted rollout and monitor
    python benchmarks/engine.py cores                   # one core against all
    python benchmarks/engine.py gradients               # against a forward rollout, d = 4 to 256
    python benchmarks/engine.py compile                 # cold, and with the compile cache warm
    python benchmarks/engine.py native                  # against plain mujoco.rollout, same threads
    python benchmarks/engine.py backends                # what backend="auto" chooses, and its speed

Rounds alternate between the sides that are compared; a ratio is the median of the ratios of
neighbouring rounds, which a noisy machine disturbs least. Compilation is left out where it is not
what is measured.
"""

import argparse
import itertools
import os
import statistics
import subprocess
import sys
import tempfile
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import verifai_jax as vj
from envs import cartpole
from specs import ball, hopper, mujoco_cartpole
from verifai_jax.core.compute.keys import run_keys, simulation_key
from verifai_jax.evaluation.backends import resolved
from verifai_jax.evaluation.differentiation import Derivative
from verifai_jax.evaluation.engine import Engine, engine_for
from verifai_jax.evaluation.host_engine import HostEngine
from verifai_jax.evaluation.verdicts import trace_verdict

KEY = run_keys(0)[1]
BATCHES = (1, 64, 1024, 4096)
POLES = {
    "x0": vj.Box(-0.5, 0.5),
    "theta0": vj.Box(-0.15, 0.15),
    "masspole": vj.Box(0.05, 0.5),
    "length": vj.Box(0.3, 1.0),
}
SPEC = "always[0, 4] (abs(x) <= 2.4 & abs(theta) <= 0.2)"
MUJOCO = {
    "cart-pole": mujoco_cartpole.balance,
    "ball": ball.over,
    "hopper": hopper.upright,
}


def points(problem, n):
    return np.random.default_rng(0).random((n, problem.space.dim), np.float32)


def seconds(call):
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


def paired(one, other, rounds):
    """Median ratio of the times of two calls, and the median time of each."""
    one(), other()
    times = [(seconds(one), seconds(other)) for _ in range(rounds)]
    firsts, seconds_ = zip(*times, strict=True)
    ratio = statistics.median(a / b for a, b in times)
    return ratio, statistics.median(firsts), statistics.median(seconds_)


def linear_cartpole():
    return vj.Problem("linear", POLES, cartpole.cartpole(cartpole.linear()), SPEC)


def network_cartpole():
    return vj.Problem("network", POLES, cartpole.cartpole(cartpole.neural()), SPEC)


def brax_pendulum():
    system = vj.brax(
        "inverted_pendulum",
        lambda observation: jnp.zeros(1),
        backend="generalized",
        steps=100,
        signals={"angle": 1},
        features={"pole": "link.inertia.mass[pole]"},
    )
    return vj.Problem("brax", {"pole": vj.Box(3.0, 6.0)}, system, "always angle <= 0.2")


def engine_of(problem, batch):
    return HostEngine(problem) if problem.black_box else engine_for(problem, batch)


def physics_steps(problem):
    """Steps of the integrator in one simulation."""
    system = problem.system
    if hasattr(system, "loop"):
        return system.loop.periods * system.loop.substeps
    return system.steps * getattr(getattr(system, "env", None), "_n_frames", 1)


def measured_speed(problem, batch, duration=0.5):
    """Physics steps a second: the best of at least three batches."""
    engine = engine_of(problem, batch)
    engine.compile()
    u = points(problem, batch)
    engine.evaluate(u, KEY, 0)
    times = []
    while len(times) < 3 or sum(times) < duration:
        times.append(seconds(lambda: engine.evaluate(u, KEY, 0)))
    return batch * physics_steps(problem) / min(times)


def speed():
    print(f"physics steps/s at batch {', '.join(map(str, BATCHES))}; best of three or more")
    problems = {
        "ODE, Euler, linear controller": linear_cartpole(),
        "ODE, Euler, network 4-32-32-2": network_cartpole(),
    }
    for name, problem in MUJOCO.items():
        for backend in ("mjx", "native"):
            problems[f"MuJoCo {name}, {backend}"] = problem.on_backend(backend)
    if hasattr(vj, "brax"):
        problems["Brax inverted pendulum, generalized"] = brax_pendulum()
    for name, problem in problems.items():
        figures = []
        for batch in BATCHES:
            try:
                figures.append(f"{measured_speed(problem, batch):>12,.0f}")
            except Exception as error:
                figures.append(f"{type(error).__name__:>12}")
        print(f"{name:<40}{' '.join(figures)}", flush=True)


def overhead():
    print("engine / bare jitted rollout and monitor over all cores, batch 1024; ms of each")
    for problem in (linear_cartpole(), network_cartpole(), MUJOCO["cart-pole"].on_backend("mjx")):
        engine = engine_for(problem, 1024)
        engine.compile()
        u = points(problem, 1024)
        split = NamedSharding(Mesh(np.array(jax.devices()), ("b",)), PartitionSpec("b"))
        features = jax.vmap(problem.space.unflatten)(u)
        keys = jax.vmap(partial(simulation_key, KEY))(jnp.arange(1024))
        features, keys = jax.device_put((features, keys), split)

        def bare(features, keys, problem=problem):
            return jax.vmap(lambda f, k: trace_verdict(problem, problem.system(f, k)))(
                features, keys
            )

        mesh, part = split.mesh, PartitionSpec("b")
        program = jax.jit(
            jax.shard_map(bare, mesh=mesh, in_specs=part, out_specs=part, check_vma=False)
        )
        ratio, ours, theirs = paired(
            lambda e=engine, u=u: e.evaluate(u, KEY, 0),
            lambda p=program, f=features, k=keys: jax.tree.map(np.asarray, p(f, k)),
            31,
        )
        print(f"{problem.name:<12}{ratio:6.3f}   {1e3 * ours:8.2f} {1e3 * theirs:8.2f}", flush=True)


ONE_THROUGHPUT = """
import os
os.sched_setaffinity(0, {cores})
from benchmarks import engine as bench
print(bench.measured_speed(bench.{problem}(), 4096, duration=2.0))
"""


def cores():
    """Processes of their own: one bound to one core, one with all, in turn."""
    every = os.sched_getaffinity(0)
    print(f"throughput on {len(every)} cores / on one, batch 4096")
    for problem in ("linear_cartpole", "network_cartpole"):
        ratios = []
        for _ in range(5):
            all_cores, one = (
                float(printed_words(ONE_THROUGHPUT.format(cores=cores, problem=problem))[0])
                for cores in (every, {min(every)})
            )
            ratios.append(all_cores / one)
        print(f"{problem:<18}{statistics.median(ratios):6.2f}", flush=True)


def printed_words(code, **environment):
    """Return the words that a Python program prints, in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": ".", **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.split()


def gradients():
    print(
        "time of value and gradient / of a rollout, batch 256; by the mode that is chosen, and by"
    )
    print("the other one")
    for d in (4, 16, 64, 256):
        space = {"wind": vj.Signal(vj.Box(-2, 2), knots=d)}
        problem = vj.Problem("wind", space, cartpole.cartpole(cartpole.linear()), SPEC)
        u = points(problem, 256)
        plain = Engine(problem, 256)
        engines = {}
        for mode in ("forward", "reverse"):
            engine = engines[mode] = Engine(problem, 256, gradient=True)
            engine.program.derivative = Derivative(d).by(mode)
            engine.compile()
        chosen = "reverse" if Derivative(d).reverse else "forward"
        ratios = {
            mode: paired(
                lambda e=engine, u=u: e.evaluate(u, KEY, 0, 0.1),
                lambda e=plain, u=u: e.evaluate(u, KEY, 0),
                11,
            )[0]
            for mode, engine in engines.items()
        }
        other = "forward" if chosen == "reverse" else "reverse"
        print(
            f"d = {d:<5}{chosen} {ratios[chosen]:6.1f}   {other} {ratios[other]:6.1f}", flush=True
        )


ONE_COMPILE = """
import sys, time
started = time.perf_counter()
import verifai_jax as vj
from benchmarks import engine as bench
problem = {name}
imported = time.perf_counter() - started
engine = bench.engine_for(problem, 1024, gradient={gradient})
engine.compile()
print(f"{{imported:.1f}} {{engine.compile_seconds:.1f}}")
"""


def compile_times():
    print("seconds to import and build the problem, and to compile it: cold, then warm cache")
    cases = {
        "ODE cart-pole": ("bench.linear_cartpole()", False),
        "ODE cart-pole, network": ("bench.network_cartpole()", False),
        "ODE cart-pole, network, gradient": ("bench.network_cartpole()", True),
        "MJX cart-pole": ('bench.MUJOCO["cart-pole"].on_backend("mjx")', False),
        "MJX hopper": ('bench.MUJOCO["hopper"].on_backend("mjx")', False),
    }
    for name, (expression, gradient) in cases.items():
        with tempfile.TemporaryDirectory() as cache:
            code = ONE_COMPILE.format(name=expression, gradient=gradient)
            cold, warm = (printed_words(code, VERIFAI_JAX_CACHE=cache)[1] for _ in range(2))
        print(f"{name:<36}cold {cold:>6}   warm {warm:>6}", flush=True)


def native():
    """Compare a network 2 x 64 in the loop with `mujoco.rollout` of the same steps without one."""
    from mujoco import rollout

    print("throughput of native simulations with a network 2 x 64 / of plain mujoco.rollout on the")
    print("same number of threads, batch 1024; physics steps/s of each")
    for name, problem in MUJOCO.items():
        problem = with_network(problem).on_backend("native")
        loop = problem.system.loop
        model, steps = loop.compiled, loop.periods * loop.substeps
        import mujoco

        threads = len(os.sched_getaffinity(0))
        data = [mujoco.MjData(model) for _ in range(threads)]
        size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        state = np.zeros(size)
        mujoco.mj_getState(model, data[0], state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        starts = np.repeat(state[None], 1024, axis=0)
        control = np.zeros((1024, steps, model.nu))
        engine = HostEngine(problem)
        u = points(problem, 1024)

        def plain(model=model, data=data, starts=starts, control=control):
            with rollout.Rollout(nthread=len(data)) as runner:
                runner.rollout(model, data, starts, control)

        ratio, ours, theirs = paired(plain, lambda e=engine, u=u: e.evaluate(u, KEY, 0), 5)
        work = 1024 * steps
        print(f"{name:<12}{ratio:6.2f}   {work / theirs:12,.0f} {work / ours:12,.0f}", flush=True)


def with_network(problem):
    """Return the problem with a random tanh network of 2 x 64 as its controller; never ends."""
    import dataclasses

    system = problem.system
    model = system.loop.compiled
    sizes = (model.nq + model.nv, 64, 64, max(model.nu, 1))
    random = np.random.default_rng(0)
    layers = [
        (random.normal(size=(a, b)).astype(np.float32) / a**0.5, np.zeros(b, np.float32))
        for a, b in itertools.pairwise(sizes)
    ]

    def control(time, state, features):
        x = jnp.concatenate([state.qpos, state.qvel])
        for weight, bias in layers:
            x = jnp.tanh(x @ weight + bias)
        return 0.01 * x[: model.nu]

    loop = dataclasses.replace(
        system.loop, controller=control, controller_memory=None, terminate=None
    )
    return dataclasses.replace(problem, system=dataclasses.replace(system, loop=loop))


def backends():
    print("simulations/s at batch 1024; what a run of 20 000 takes, and its speed / the best one's")
    for name, problem in MUJOCO.items():
        speeds = {}
        for backend in ("native", "mjx"):
            on = problem.on_backend(backend)
            speeds[backend] = measured_speed(on, 1024) / physics_steps(on)
        choice = resolved(problem, batch=1024, budget=20_000)
        share = speeds[choice.backend] / max(speeds.values())
        columns = "  ".join(f"{backend} {figure:8,.0f}" for backend, figure in speeds.items())
        print(f"{name:<12}{columns}   auto: {choice.backend} {share:.2f}", flush=True)


PARTS = {
    "speed": speed,
    "overhead": overhead,
    "cores": cores,
    "gradients": gradients,
    "compile": compile_times,
    "native": native,
    "backends": backends,
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="all when left out")
    for part in parser.parse_args().parts or PARTS:
        print(f"-- {part}")
        PARTS[part]()
