"""The GPU and the CPU of one machine: throughput, monitor, MuJoCo, frames, training, a sweep.

    python benchmarks/gpu.py                            # ten minutes; writes its section
    python benchmarks/gpu.py --tiny --only cpu --print  # a look at the code, without a GPU

Each side has a process of its own, `JAX_PLATFORMS=cpu` and JAX's own choice, one after the other;
each figure is the best of three rounds, without compilation, which is reported apart. Whatever
raises is a line that says so, and the others go on. With `--print` the section goes to the standard
output, and the file stays as it is.
"""

import argparse
import json
import os
import platform
import re
import subprocess
import sys
import time
from pathlib import Path

RESULTS = Path(__file__).parent / "RESULTS.md"
HEADING = "## Accelerators (`benchmarks/gpu.py`)"
BEFORE = "## The engine on real dynamics"
"""Heading in front of which the section stands."""
ROUNDS = 3


def best(call, amount):
    """Return `amount` per second in the best round, and the seconds of the first call over it."""
    started = time.perf_counter()
    call()
    first = time.perf_counter() - started
    rounds = []
    for _ in range(ROUNDS):
        started = time.perf_counter()
        call()
        rounds.append(time.perf_counter() - started)
    return amount / min(rounds), max(first - min(rounds), 0.0)


def simulations(problem, batch):
    """Return simulations per second of a problem in batches of this size."""
    import numpy as np

    from verifai_jax.evaluation.evaluator import Evaluator

    evaluate = Evaluator(problem, batch)
    u = np.random.default_rng(0).random((batch, problem.space.dim)).astype(np.float32)
    return best(lambda: evaluate(u, first=0), batch)


def throughput(tiny):
    """Measure the cart-pole under its network, 200 steps."""
    from specs import cartpole

    for batch in (1024,) if tiny else (8192, 65_536, 524_288):
        yield f"cart-pole, batch {batch:,}", "simulations/s", simulations(cartpole.balance, batch)


def monitor(tiny):
    """Measure the monitor alone, forward and with gradients."""
    import jax
    import jax.numpy as jnp

    import verifai_jax as vj

    length, batch = (100, 64) if tiny else (1000, 16_384)
    keys = jax.random.split(jax.random.key(0))
    signals = {n: jax.random.normal(k, (batch, length)) for n, k in zip("pq", keys, strict=True)}
    for text in ("G (p > 0)", "G ((p > 0) -> F[0,10] (q > 0))", "G ((p > 0) U[5,50] (q > 0))"):
        formula = vj.parse(text)

        def rho(signals, semantics, formula=formula):
            return vj.robustness(formula, vj.Trace(signals, dt=1.0), semantics)

        def slope(signals, rho=rho):
            return jax.grad(lambda s: rho(s, vj.mtl.smooth(0.1)))(signals)

        used = {name: signals[name] for name in formula.signals()}
        forward = jax.jit(jax.vmap(lambda s, rho=rho: rho(s, vj.mtl.hard)))
        gradient = jax.jit(jax.vmap(slope))
        for name, program in (("", forward), (", gradient", gradient)):
            amount = batch * length / 1e6

            def call(program=program, used=used):
                jax.tree.map(jnp.asarray, jax.block_until_ready(program(used)))

            yield f"`{text}`{name}, {batch:,} traces", "million samples/s", best(call, amount)


def humanoid():
    """Return MuJoCo's own humanoid, that stands for a second and falls; its feet touch."""
    import mujoco

    import verifai_jax as vj

    model = Path(mujoco.__file__).parent / "mjx/test_data/humanoid/humanoid.xml"
    system = vj.mujoco(
        str(model),
        duration=1.0,
        control_period=0.02,
        bind={"bend": "joint/knee_right/qpos", "gravity": "option/gravity[2]"},
        signals={"height": "body/torso/xpos[2]"},
    )
    space = vj.FeatureSpace({"bend": vj.Box(-1.5, 0.0), "gravity": vj.Box(-10.5, -9.0)})
    return vj.Problem("humanoid", space, system, "always (height >= 0.3)")


def mujoco(tiny):
    """Measure MuJoCo as it is used: MJX on an accelerator, native MuJoCo on a processor."""
    import jax

    from specs import hopper, mujoco_cartpole

    backend = "native" if jax.default_backend() == "cpu" else "mjx"
    chosen = {"pole": mujoco_cartpole.balance}
    if not tiny:
        chosen |= {"hopper": hopper.upright, "humanoid": humanoid()}
    for name, problem in chosen.items():
        steps = problem.system.loop.periods * problem.system.loop.substeps
        for batch in (16,) if tiny else (1024, 8192):
            speed, compiling = simulations(problem.on_backend(backend), batch)
            yield f"MuJoCo {name}, batch {batch:,}", "physics steps/s", (speed * steps, compiling)


def frames(tiny):
    """Measure the images of a whole scene, and the detector that looks at them."""
    import jax

    from envs import cones
    from envs.train_cones import SPACES

    count = 64 if tiny else 16_384
    points = jax.random.uniform(jax.random.key(0), (count, SPACES["wide"].dim))
    network = cones.load_detector(cones.NETWORKS["wide"])
    size = min(count, 8 if jax.default_backend() == "cpu" else 2048)

    def image(u):
        f = SPACES["wide"].unflatten(u)
        pose = cones.Pose(-f["ahead"], f["offset"], f["heading"])
        return cones.render(f, pose, f["present"] > 0, *network.shape)

    def seen(u):
        return network(image(u)).presence

    for name, function in (("drawn", lambda u: image(u).mean()), ("drawn and looked at", seen)):
        program = jax.jit(lambda u, function=function: jax.lax.map(function, u, batch_size=size))

        def call(program=program):
            jax.block_until_ready(program(points))

        yield f"frames of 24 x 48 {name}", "frames/s", best(call, count)


def training(tiny):
    """Measure PPO on the cart-pole, many learning rates side by side."""
    from envs.cartpole_task import CartPoleTask
    from verifai_jax.addons.rl import PPO
    from verifai_jax.addons.rl.batched_training import BatchedTraining, Configuration

    for count, steps in ((2, 1024),) if tiny else ((64, 32_768), (256, 32_768)):

        def train(count=count, steps=steps):
            runs = [
                Configuration(CartPoleTask(), PPO(learning_rate=1e-4 * (1 + i)), steps, seed=i)
                for i in range(count)
            ]
            batch = BatchedTraining(runs)
            for number in batch.advance(dict.fromkeys(range(count), steps)):
                batch.policy(number)

        yield f"PPO, {count} trainings", "environment steps/s", best(train, count * steps)


def sweep(tiny):
    """Measure a whole sweep with its certificates: the mountain car."""
    import verifai_jax as vj
    from specs import mountain_car

    study = mountain_car.safe_training
    options = {"configurations": 1 if tiny else 6}
    options["certification"] = vj.Certification(samples=64 if tiny else 512)
    if tiny:
        from dataclasses import replace

        study = replace(study, trainer=replace(study.trainer, steps=2048), checkpoints=())
    options |= {"attack_simulations": 64, "progress": False}
    started = time.perf_counter()
    vj.sweep(study, **options)
    seconds = time.perf_counter() - started
    yield f"sweep of {options['configurations']} configurations", "sweeps/hour", (3600 / seconds, 0)


PARTS = {
    "throughput": throughput,
    "monitor": monitor,
    "mujoco": mujoco,
    "frames": frames,
    "training": training,
    "sweep": sweep,
}


def measure(parts, tiny):
    """Measure on the devices of this process, and print a line of JSON for each figure."""
    import jax

    import verifai_jax as vj

    device = jax.local_devices()[0]
    about = {"platform": device.platform, "device": device.device_kind, "jax": jax.__version__}
    print(json.dumps(about | {"devices": len(jax.local_devices()), "version": vj.__version__}))
    for part in parts:
        try:
            for what, unit, (speed, compiling) in PARTS[part](tiny):
                entry = {"what": what, "unit": unit, "speed": speed, "compiling": compiling}
                print(json.dumps(entry), flush=True)
        except Exception as error:
            text = str(error).strip().split("\n")[0][:120]
            print(
                json.dumps({"what": part, "error": f"{type(error).__name__}: {text}"}), flush=True
            )


def side(platforms, parts, tiny):
    """Measure in a process of its own; return what it said of its device, and its figures."""
    paths = [str(Path(__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    environment.pop("JAX_PLATFORMS", None)
    if platforms is not None:
        environment["JAX_PLATFORMS"] = platforms
    command = [sys.executable, __file__, "--measure", *parts, *(["--tiny"] if tiny else [])]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=False)
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    if not lines:
        sys.exit(f"nothing was measured (exit status {done.returncode}); see above")
    return lines[0], {entry["what"]: entry for entry in lines[1:]}


def cell(entry):
    """Write a figure, or what was raised instead."""
    if entry is None:
        return "not measured"
    return entry["error"] if "error" in entry else f"{entry['speed']:,.4g}"


def section(sides):
    """Write the section: a row for each figure, with the ratio where both sides have one."""
    cpu, *others = sides
    other = others[0] if others else ({}, {})
    names = list(dict.fromkeys([*cpu[1], *other[1]]))
    lines = [HEADING, ""]
    lines.append(
        f"{time.strftime('%Y-%m-%d')}, verifai_jax {cpu[0]['version']}, JAX {cpu[0]['jax']}, "
        f"Python {platform.python_version()}, CPU with {cpu[0]['devices']} cores in use"
        + (f", {other[0]['device']}" if others else "; no accelerator was measured")
        + ". Best of three rounds; seconds to compile in brackets."
    )
    lines += ["", f"| | unit | CPU | {other[0].get('device', 'accelerator')} | ratio |"]
    lines.append("|---|---|---|---|---|")
    for name in names:
        one, two = cpu[1].get(name), other[1].get(name)
        texts = []
        for entry in (one, two):
            more = f" ({entry['compiling']:.0f} s)" if entry and entry.get("compiling") else ""
            texts.append(cell(entry) + more)
        known = one and two and "speed" in one and "speed" in two
        ratio = f"{two['speed'] / one['speed']:.2g}" if known else ""
        unit = (one or two or {}).get("unit", "")
        lines.append(f"| {name} | {unit} | {texts[0]} | {texts[1]} | {ratio} |")
    return "\n".join(lines) + "\n\n"


def written(results, text):
    """Return the results with this section in place of an earlier one, or where it belongs."""
    old = re.compile(rf"^{re.escape(HEADING)}\n.*?(?=^## |\Z)", re.DOTALL | re.MULTILINE)
    if old.search(results):
        return old.sub(lambda _: text, results)
    index = results.find(BEFORE)
    return results + "\n" + text if index < 0 else results[:index] + text + results[index:]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}; all when left out")
    parser.add_argument("--tiny", action="store_true", help="sizes of a test")
    parser.add_argument("--only", choices=["cpu"], help="the CPU alone")
    parser.add_argument("--print", action="store_true", dest="prints", help="do not write the file")
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    parts = options.parts or list(PARTS)
    for part in parts:
        if part not in PARTS:
            parser.error(f"there is no part {part!r}; there are {', '.join(PARTS)}")
    if options.measure:
        measure(parts, options.tiny)
        return
    sides = [side("cpu", parts, options.tiny)]
    if options.only is None:
        found = side(None, parts, options.tiny)
        if found[0]["platform"] == "cpu":
            sys.exit("JAX finds no accelerator here; --only cpu --print measures the CPU alone")
        sides.append(found)
    text = section(sides)
    print(text)
    if not options.prints:
        RESULTS.write_text(written(RESULTS.read_text(), text))


if __name__ == "__main__":
    main()
