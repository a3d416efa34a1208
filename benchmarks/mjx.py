"""An ant in MJX: our rollout and its gradient beside plain JAX around `mjx.step`.

    python benchmarks/mjx.py [--rows 64] [--steps 200] [--rounds 5]

The ant of Gymnasium with two features (the height it is dropped from, and gravity), all of whose
motors are off. Both sides minimise the same smooth number, the least height of the torso. Each side
is a process of its own; the ratio is of the medians of its rounds. The peak of memory is that of
the process after it has compiled, above what it held before it ran.
"""

import argparse
import json
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path


def model_with(iterations):
    """Return the ant with Euler steps and a number of iterations that allows reverse mode."""
    import gymnasium
    import mujoco

    file = Path(gymnasium.__file__).parent / "envs/mujoco/assets/ant.xml"
    spec = mujoco.MjSpec.from_file(str(file))
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.iterations, spec.option.ls_iterations = iterations, 4
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    return spec


def ours(rows, steps, gradient, iterations):
    """Return our engine's call, on MJX."""
    import numpy as np

    import verifai_jax as vj
    from verifai_jax.core.compute.keys import run_keys
    from verifai_jax.evaluation.engine import engine_for

    spec = model_with(iterations)
    system = vj.mujoco(
        spec, duration=steps * 0.01, control_period=0.01, backend="mjx",
        bind={"drop": "joint/root/qpos[2]", "gravity": "option/gravity[2]"},
        signals={"height": "body/torso/xpos[2]"},
    )  # fmt: skip
    space = vj.FeatureSpace({"drop": vj.Box(0.5, 1.0), "gravity": vj.Box(-10.5, -9.0)})
    problem = vj.Problem("ant", space, system, "always (height >= 0.3)")
    engine = engine_for(problem, rows, gradient)
    u, key = np.random.default_rng(0).random((rows, 2), np.float32), run_keys(0)[1]
    return lambda: np.asarray(engine.evaluate(u, key, 0, 0.1).rho)


def plain(rows, steps, gradient, iterations):
    """Return what a user of JAX and MJX writes."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    from mujoco import mjx

    compiled = model_with(iterations).compile()
    model = mjx.put_model(compiled, impl="jax")
    blank = mjx.make_data(model)

    def robustness(u):
        drop, gravity = 0.5 + 0.5 * u[0], -10.5 + 1.5 * u[1]
        changed = model.tree_replace({"opt.gravity": model.opt.gravity.at[2].set(gravity)})
        data = blank.replace(qpos=jnp.asarray(compiled.qpos0).at[2].set(drop))

        def step(data, _):
            return mjx.step(changed, data), data.qpos[2]

        _, heights = jax.lax.scan(step, data, length=steps + 1)
        least = -0.1 * jax.nn.logsumexp(-(heights - 0.3) / 0.1) if gradient else None
        return jnp.min(heights) - 0.3 if least is None else least

    value = robustness if not gradient else lambda u: jax.value_and_grad(robustness)(u)
    if gradient and iterations != 1:
        value = lambda u: (robustness(u), jax.jacfwd(robustness)(u))  # noqa: E731
    program = jax.jit(jax.vmap(value))
    u = np.random.default_rng(0).random((rows, 2), np.float32)
    return lambda: np.asarray(jax.tree.leaves(jax.block_until_ready(program(u)))[0])


def measured(side, rows, steps, rounds, gradient, iterations):
    call = {"ours": ours, "plain": plain}[side](rows, steps, gradient, iterations)
    began = time.perf_counter(), time.process_time()
    call()
    first = time.perf_counter() - began[0], time.process_time() - began[1]
    rounds_of = []
    for _ in range(rounds):
        wall, cpu = time.perf_counter(), time.process_time()
        values = call()
        rounds_of.append((time.perf_counter() - wall, time.process_time() - cpu))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({
        "first": first, "wall": statistics.median(w for w, _ in rounds_of),
        "cpu": statistics.median(c for _, c in rounds_of), "peak": peak,
        "mean": float(values.mean()),
    }))  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rows", type=int, default=64)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--side", choices=["ours", "plain"])
    parser.add_argument("--gradient", action="store_true")
    parser.add_argument("--iterations", type=int, default=1)
    o = parser.parse_args()
    if o.side:
        measured(o.side, o.rows, o.steps, o.rounds, o.gradient, o.iterations)
        return
    for iterations in (1, 4):
        for what in ("forward", "gradient"):
            sides = {}
            for side in ("plain", "ours"):
                command = [sys.executable, __file__, "--side", side, "--rows", o.rows, "--steps"]
                command += [o.steps, "--rounds", o.rounds, "--iterations", iterations]
                command += ["--gradient"] * (what == "gradient")
                done = subprocess.run([*map(str, command)], capture_output=True, text=True)
                if done.returncode:
                    print(f"{iterations} iterations, {what}, {side}: {done.stderr[-300:]}")
                    break
                sides[side] = json.loads(done.stdout.splitlines()[-1])
                print(f"  {iterations} iterations, {what}, {side}: {sides[side]}", flush=True)
            if len(sides) == 2:
                a, b = sides["ours"], sides["plain"]
                print(
                    f"{iterations} iterations, {what}: {a['wall'] / b['wall']:z.2f} times plain "
                    f"({a['cpu'] / b['cpu']:z.2f} by processor time), first call "
                    f"{a['first'][1] / b['first'][1]:z.2f}, peak {a['peak'] / b['peak']:z.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
