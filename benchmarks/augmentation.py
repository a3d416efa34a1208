"""Ten ways to choose training data for a network that sees cones, over seeds; see RESULTS.md.

    python benchmarks/augmentation.py in_distribution [--seeds 5] [--folder augmentations]
    python benchmarks/augmentation.py shifted [--seeds 5] [--folder augmentations] [--arms A,B,C]

The scene, the network and the closed loop are those of `benchmarks/augmentation_scene.py`.
`in_distribution`: the base is trained on 1000 images from the whole domain. `shifted`: from a
domain without glare, and without cones before cars that are as red as the cones; error table and
tests are of the whole, and the failure rate of the closed loop is measured. Interrupted, either
goes on where it was.
"""

import argparse
from pathlib import Path

import jax
from augmentation_scene import smallest_gaps, task

import verifai_jax as vj
from verifai_jax.addons.training.paired import paired_difference

OPTIONS = {"initial": 1000, "added": 200, "steps": (600, 300)}


def compare(result, metric):
    """Print every arm's mean of a metric, and its differences to none and to random."""
    print(f"\n{metric}: means over seeds, and differences with 95 % t intervals")
    for arm, mean in result.means[metric].items():
        row = f"  {arm:<16}{100 * mean:6.2f} %"
        for reference in ("none", "random"):
            difference = result.compare(metric, reference).get(arm)
            if difference is None:
                row += f"{'':28}"
                continue
            ends = f"({100 * difference.low:+.2f} to {100 * difference.high:+.2f})"
            row += f"  {100 * difference.mean:+6.2f} {ends:<19}"
        print(row)


def run(args, shifted):
    name = "shifted" if shifted else "in_distribution"
    folder = None if args.folder is None else Path(args.folder) / name
    arms = "all" if args.arms is None else args.arms.split(",")
    result = vj.augment(task(shifted), arms, seeds=args.seeds, folder=folder, **OPTIONS)
    print(result)
    for metric in result.metrics:
        compare(result, metric)
    differences = result.compare("error", "none")
    by_search, blind = differences["counterexamples"], differences["random"]
    print(
        f"\ngain of counterexamples over that of random inputs: {by_search.mean / blind.mean:.2f}"
    )
    print(f"counterexamples against random: {result.compare('error', 'random')['counterexamples']}")
    errors = {
        arm: result.table.loc[result.table["arm"] == arm, "error"].to_numpy() for arm in result.arms
    }
    # Twice the gain of random inputs: 2 random - none is what counterexamples have to beat.
    twice = paired_difference(errors["counterexamples"], 2 * errors["random"] - errors["none"])
    print(f"counterexamples against twice the gain of random: {twice}")
    if folder is not None:
        result.plot(folder / "arms.png")
        result.montage(folder / "added.png")
        if shifted:
            result.plot(folder / "loop.png", "loop_failures")
    if shifted:
        loops = result.table.pivot(index="seed", columns="arm", values="loop_failures")
        for arm in ("none", "base"):
            half = paired_difference(loops["counterexamples"].to_numpy(), loops[arm].to_numpy() / 2)
            print(f"loop failures with counterexamples against half of those of {arm}: {half}")
    print(f"\nrules of the error table of seed 0:\n{vj.analysis.rules(result.error_tables[0])}")
    if shifted:
        gaps, _ = smallest_gaps(None, jax.random.key(1), 10_240, "truth")
        print(
            f"with perfect perception {int((gaps < 0.8).sum())} of {len(gaps)} drives fail; "
            f"least gap {gaps.min():.2f} m"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=("in_distribution", "shifted"))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--folder", type=str)
    parser.add_argument("--arms", help="names, comma-separated; all ten when left out")
    arguments = parser.parse_args()
    run(arguments, arguments.what == "shifted")
