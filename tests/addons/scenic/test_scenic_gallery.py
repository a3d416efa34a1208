"""Every program of the gallery: Scenic's scenes, Scenic's refusals, Scenic's distribution."""

import random
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.stats import ks_2samp

from verifai_jax.addons.scenic import scenic
from verifai_jax.addons.scenic.sampling import Refused

pytest.importorskip("scenic")
pytestmark = [pytest.mark.thorough, pytest.mark.filterwarnings("ignore")]

GALLERY = sorted((Path(__file__).parent / "gallery").glob("*.scenic"))
POINTS, THEIRS, OURS = 48, 100, 1500
MIN_P = 0.01 / 200
"""A hundredth, over the number of all comparisons of the gallery (Bonferroni)."""


def poses(body):
    return {"x": body.position.x, "y": body.position.y, "heading": body.orientation.yaw}


def apart(one, other):
    """Return the greatest difference of two poses, modulo full turns."""
    turned = (one["heading"] - other["heading"] + np.pi) % (2 * np.pi) - np.pi
    return max(abs(one["x"] - other["x"]), abs(one["y"] - other["y"]), abs(turned))


def test_there_are_twenty_programs_and_a_map():
    assert len(GALLERY) >= 20
    assert (GALLERY[0].parent / "two_lanes.xodr").exists()


@pytest.mark.slow
@pytest.mark.parametrize("path", GALLERY, ids=lambda path: path.stem)
def test_scenes_refusals_and_distribution_are_those_of_scenic(path):
    program = scenic(path)
    space, names = program.space, [name for name in program.objects if name != "params"]
    count = 12 if path.stem == "road" else POINTS
    size = 160 if program.by_scenic or program.in_python else OURS
    points = np.random.default_rng(3).random((size, space.dim), np.float32)

    @jax.jit
    @jax.vmap
    def together(u):
        features = space.unflatten(u)
        return features, program.scenes(features), space.accepts(features)

    features, scenes, accepted = jax.tree.map(np.asarray, together(points))
    for i in range(count):
        here = {name: np.asarray(column[i]) for name, column in features.items()}
        refusal = program.refusal(here)
        assert (refusal is None) == accepted[i], f"point {i}: {refusal}"
        try:
            values = program._sampling.values(here)
        except Refused:
            continue
        for name, body in zip(names, program.scenario.objects, strict=True):
            ours = {key: float(scenes[name][key][i]) for key in ("x", "y", "heading")}
            assert apart(ours, poses(values[body])) < 2e-4
        if refusal is None and not program.seeded:
            scene = program._sampling.scene(values)
            again = program.scene(program.features_of(scene))
            for one, other in zip(scene.objects, again.objects, strict=True):
                assert apart(poses(one), poses(other)) < 2e-3

    random.seed(1)
    np.random.seed(1)  # noqa: NPY002 - what Scenic draws from
    sampled = 40 if path.stem == "road" else THEIRS
    theirs = [program.scenario.generate(maxIterations=5000)[0] for _ in range(sampled)]
    for i, name in enumerate(names):
        for key in ("x", "y", "heading"):
            # Rounded alike, since values that come again and again are compared exactly.
            one = np.round([poses(scene.objects[i])[key] for scene in theirs], 3)
            other = np.round(scenes[name][key][accepted].astype(float), 3)
            if np.ptp(one) > 0:
                assert ks_2samp(one, other).pvalue > MIN_P, f"{name}.{key}"
