"""The camera and the loop of specs/cones.py: frames, gradients, simulations, failure rates.

    python benchmarks/perception.py frames [--rounds 5]
    MUJOCO_GL=egl python benchmarks/perception.py mujoco
    python benchmarks/perception.py loop [--simulations 2000]

Frames and gradients are counted by CPU time, as on one core; the loop by wall time on all cores,
compilation apart. Rates have Clopper-Pearson intervals of 95 %.
"""

import argparse
import statistics
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import verifai_jax as vj
from envs import cones
from envs.train_cones import SPACES
from specs import cones as specs
from verifai_jax.core.devices import enable_compile_cache
from verifai_jax.core.errors import require

FRAMES = 1024
SIZES = ((24, 48), (48, 96))


def cpu_seconds(work, rounds: int) -> float:
    """Return the median CPU time of `work()`, after one call to compile."""
    jax.block_until_ready(work())
    taken = []
    for _ in range(rounds):
        begun = time.process_time()
        jax.block_until_ready(work())
        taken.append(time.process_time() - begun)
    return statistics.median(taken)


def frames(rounds: int) -> None:
    """Print frames and gradients a second, the whole scene of the case study."""
    points = jax.random.uniform(jax.random.key(0), (FRAMES, SPACES["wide"].dim))
    network = cones.load_detector(cones.NETWORKS["wide"])
    print("| | pixels | frames/s of CPU time | compile s |\n|---|---|---|---|")
    for height, width in SIZES:

        def image(u, height=height, width=width):
            f = SPACES["wide"].unflatten(u)
            pose = cones.Pose(-f["ahead"], f["offset"], f["heading"])
            return cones.render(f, pose, f["present"] > 0, height, width)

        def mean(u, image=image):
            return jnp.mean(image(u) ** 2)

        def seen(u, image=image):
            return network(image(u)).presence

        work = {"image": (mean, 8), "image, one at a time": (mean, None)}
        work |= {"value and gradient": (jax.value_and_grad(mean), 8)}
        if (height, width) == network.shape:
            work |= {"image and network": (seen, 8)}
        for name, (function, size) in work.items():

            def mapped(u, function=function, size=size):
                return jax.lax.map(function, u, batch_size=size)

            begun = time.process_time()
            program = jax.jit(mapped).lower(points).compile()
            compiled = time.process_time() - begun
            seconds = cpu_seconds(lambda program=program: program(points), rounds)
            print(f"| {name} | {height} x {width} | {FRAMES / seconds:,.0f} | {compiled:.1f} |")


MJCF = """
<mujoco><worldbody>
  <light pos="0 0 9"/><geom type="plane" size="99 99 1"/>
  <geom type="box" size="2.1 .9 .3" pos="16 0 .55" rgba=".9 .5 .1 1"/>
  <geom type="box" size="1.1 .8 .3" pos="16 0 1.1" rgba=".4 .3 .2 1"/>
  <geom type="cylinder" size=".25 .37" pos="8 -.7 .37" rgba="1 .4 0 1"/>
  <geom type="cylinder" size=".25 .37" pos="10 -.7 .37" rgba="1 .4 0 1"/>
  <geom type="cylinder" size=".25 .37" pos="12 -.7 .37" rgba="1 .4 0 1"/>
  <camera name="eye" pos="0 0 1.3" xyaxes="0 -1 0 0 0 1" fovy="18"/>
</worldbody></mujoco>
"""


def mujoco_frames(rounds: int) -> None:
    """Print frames a second of MuJoCo's own renderer, five solids and no effects."""
    mujoco = require("mujoco", "mujoco")
    model = mujoco.MjModel.from_xml_string(MJCF)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for height, width in SIZES:
        with mujoco.Renderer(model, height, width) as renderer:

            def work(renderer=renderer):
                for _ in range(20):
                    renderer.update_scene(data, "eye")
                    renderer.render()

            begun = time.perf_counter()
            seconds = cpu_seconds(work, rounds) / 20
            wall = (time.perf_counter() - begun) / (20 * (rounds + 1))
        print(
            f"mujoco.Renderer {height} x {width}: {1 / seconds:.0f} frames/s of CPU time, ", end=""
        )
        print(f"{1 / wall:.0f} of wall time")


def loop(simulations: int) -> None:
    """Print simulations a second and failure rates of all problems."""
    names = ("perfectly", "wide", "narrow", "braking_perfectly", "braking_wide", "braking_narrow")
    columns = ("problem", "simulations/s", "of CPU time", "formula", "all", "orange", "others")
    print(f"| {' | '.join(columns)} |")
    print("|---|---|---|---|---|---|---|")
    for name in names:
        problem = getattr(specs, name)
        run = vj.falsify(problem, "uniform", simulations, batch=256, seed=1, confirm=False)
        begun = time.process_time()
        again = vj.falsify(problem, "uniform", 512, batch=256, seed=2, confirm=False)
        rate = 512 / again.run_seconds, 512 / (time.process_time() - begun)
        table = run.table.all
        orange = (table["car_hue"] < cones.ORANGE).to_numpy()
        for column in [c for c in table.columns if c == "rho" or c.startswith("rho.")]:
            fails = (table[column] < 0).to_numpy()
            cells = [
                rate_text(fails[rows]) for rows in (np.full(len(fails), True), orange, ~orange)
            ]
            formula = column.removeprefix("rho.") if "." in column else "any"
            print(f"| {name} | {rate[0]:,.0f} | {rate[1]:,.0f} | {formula} | {' | '.join(cells)} |")


def rate_text(fails: np.ndarray) -> str:
    """Return a rate in percent, its interval and its counts."""
    rate = vj.clopper_pearson(int(fails.sum()), len(fails))
    return (
        f"{100 * fails.mean():.2g} % ({100 * rate.low:.2g} to {100 * rate.high:.2g}; "
        f"{rate.failures} of {rate.simulations})"
    )


def main() -> None:
    """Measure what is named."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("what", choices=("frames", "mujoco", "loop"))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--simulations", type=int, default=2000)
    chosen = parser.parse_args()
    enable_compile_cache()
    if chosen.what == "loop":
        loop(chosen.simulations)
    else:
        {"frames": frames, "mujoco": mujoco_frames}[chosen.what](chosen.rounds)


if __name__ == "__main__":
    main()
