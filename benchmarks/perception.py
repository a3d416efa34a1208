"""The camera and the loop of specs/cones.py: frames, gradients, simulations, failure rates.

    python benchmarks/perception.py frames [--rounds 5]
    MUJOCO_GL=egl python benchmarks/perception.py mujoco
    python benchmarks/perception.py loop [--simulations 2000]
    python benchmarks/perception.py compositional [--seeds 20]
    python benchmarks/perception.py gradient [--seeds 8]

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
from verifai_jax.core.compute.devices import enable_compile_cache
from verifai_jax.core.messages.errors import require

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


COLLISIONS = vj.Problem(
    "collisions of the wide network",
    specs.space("lanechange"),
    cones.cones(cones.neural("wide")),
    specs.SAFE,
)


def compositional(seeds: int) -> None:
    """Print the rendered images until the first collision that the wide network causes.

    `uniform` and `cross_entropy` simulate the loop, up to the failing row; the compositional
    analysis looks for single images by either search, and counts its simulations too.
    """
    per = round(8 * cones.FRAME_RATE) + 1
    counts: dict[str, list[int]] = {}
    for seed in range(seeds):
        for search in ("uniform", "cross_entropy"):
            run = vj.falsify(
                COLLISIONS,
                search,
                50_000,
                seed=seed,
                batch=64,
                stop=vj.Stop(after=1),
                confirm=False,
            )
            counts.setdefault(search, []).append(per * (first_failure(run) + 1))
        for search in ("uniform", "cross_entropy"):
            result = vj.perception.abstract(
                COLLISIONS, abstraction, COLLISIONS.system.frame, ERROR,
                search=search, seed=seed, budget=50_000,
            )  # fmt: skip
            assert len(result.confirmed) == 1
            counts.setdefault(f"compositional, {search}", []).append(result.frames["total"])
        print(seed, {name: values[-1] for name, values in counts.items()}, flush=True)
    print("| | median | quartiles | extremes | fewer than uniform |\n|---|---|---|---|---|")
    for name, values in counts.items():
        lowest, first, median, third, maximum = np.quantile(values, [0, 0.25, 0.5, 0.75, 1])
        fewer = np.median(np.array(counts["uniform"]) / np.array(values))
        print(
            f"| {name} | {median:,.0f} | {first:,.0f} to {third:,.0f} | {lowest:,.0f} to "
            f"{maximum:,.0f} | {np.median(counts['uniform']) / median:.3g} (of pairs: "
            f"{fewer:.3g}) |"
        )


ERROR = "distance < 15 and (estimate > 15 or logit < 0)"


def abstraction(severity):
    """The loop without images, which sees cones late."""
    return cones.cones(cones.late(severity))


def first_failure(run: vj.Run) -> int:
    """Return the number of the first row that violates the property."""
    failing = run.table.counterexamples
    assert len(failing), f"{run.search} found nothing in {run.simulations} simulations"
    return int(failing.index.min())


MARGIN = "always (distance < 12 -> reading < 15 and logit > 0)"
"""`seen` by what the network computes, which does not saturate, in place of what it decides."""


def one_image(features, key=None):
    """One image of cones that are nearer than 12 m."""
    pose = cones.Pose(-features["ahead"], features["offset"], features["heading"])
    distance = cones.distance_of_nearest(features, pose)
    logit, reading = WIDE(features, pose)
    signals = {"distance": distance, "reading": reading, "logit": logit}
    return vj.Trace({name: value[None] for name, value in signals.items()}, dt=1.0)


WIDE = cones.neural("wide")
one_image.lanes = 8


def gradient(seeds: int) -> None:
    """Print simulations and seconds until the first failure, by searches with slopes or without."""
    space = specs.space("lanechange")
    road = {"ahead": vj.Box(4.0, 12.0), "offset": vj.Box(-0.5, 0.5), "heading": vj.Box(-0.08, 0.08)}
    images = vj.FeatureSpace({**cones.SCENERY, **cones.WEATHER, **road})
    problems = [
        vj.Problem("one image", images, one_image, MARGIN),
        vj.Problem("loop, margin", space, cones.cones(WIDE), MARGIN),
        vj.Problem("loop, decision", space, cones.cones(WIDE), specs.SEEN),
        COLLISIONS,
    ]
    print("| problem | search | found | simulations | s | compile s |")
    print("|---|---|---|---|---|---|")
    for problem in problems:
        for search in ("uniform", "cross_entropy", "gradient"):
            spent, seconds, compiled, found = [], [], 0.0, 0
            for seed in range(seeds):
                run = vj.falsify(
                    problem,
                    search,
                    BUDGET,
                    seed=seed,
                    batch=16,
                    stop=vj.Stop(after=1),
                    confirm=False,
                )
                compiled = max(compiled, run.compile_seconds)
                found += len(run.table.counterexamples) > 0
                spent.append(run.simulations)
                seconds.append(run.run_seconds)
            print(
                f"| {problem.name} | {search} | {found} of {seeds} | {np.median(spent):,.0f} | "
                f"{np.median(seconds):.2g} | {compiled:.0f} |",
                flush=True,
            )


BUDGET = 2048


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
    parser.add_argument("what", choices=("frames", "mujoco", "loop", "compositional", "gradient"))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--simulations", type=int, default=2000)
    parser.add_argument("--seeds", type=int)
    chosen = parser.parse_args()
    enable_compile_cache()
    if chosen.what == "loop":
        loop(chosen.simulations)
    elif chosen.what == "compositional":
        compositional(chosen.seeds or 20)
    elif chosen.what == "gradient":
        gradient(chosen.seeds or 8)
    else:
        {"frames": frames, "mujoco": mujoco_frames}[chosen.what](chosen.rounds)


if __name__ == "__main__":
    main()
