"""How many simulations the active searches need on landscapes with a known failure rate.

`benchmarks/search_quality.py` measures the same with more seeds. Bayesian optimization has tests
of its own, as it plays with fewer simulations.
"""

import math

import jax
import numpy as np
import pytest
from playing import FLAT, MIXED, SEEDS, WIDE, gain, play, played

from benchmarks.landscapes import LANDSCAPES
from verifai_jax.search import named, names

# By how much each has to beat uniform sampling: what its method gives with a margin for luck.
GAIN = {
    "cross_entropy": 6,
    "gradient": 8,
    "descent": 6,
    "bandit": 4,
    "epsilon_greedy": 4,
    "annealing": 2.5,
    "mutation": 2.5,
    "portfolio": 2,
}
# Without add-ons there are fewer.
SEARCHES = [name for name in GAIN if name in names()]
# Ripples point a descent into the next of many hollows, and choices have no slope.
POINTLESS = {
    ("descent", "ripples"), ("gradient", "ripples"), ("gradient", "mixed"), ("gradient", "needle"),
}  # fmt: skip
# A program of all members takes long to compile.
LARGE = ("portfolio",)
EACH = pytest.mark.parametrize(
    "search",
    [pytest.param(s, marks=pytest.mark.proves if s in LARGE else ()) for s in SEARCHES],
)


@pytest.mark.proves
@pytest.mark.parametrize("name", LANDSCAPES)
def test_the_failure_rates_are_as_stated(name):
    rho, cube, share = LANDSCAPES[name]
    u = np.random.default_rng(0).random((2**18, cube.dim), np.float32)
    failures = int(np.sum(jax.jit(jax.vmap(rho))(u) < 0))
    assert abs(failures - share * 2**18) < 5 * math.sqrt(share * 2**18)


@pytest.mark.proves
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.proves if name in MIXED else ())
        for name in FLAT + MIXED
        if name != "needle"
    ],
)
@EACH
def test_beats_uniform(search, name):
    if (search, name) in POINTLESS:
        pytest.skip("gradients say nothing here")
    assert gain(name, played(named(search), name)[1]) > GAIN[search]


@pytest.mark.proves
@pytest.mark.parametrize("name", WIDE)
@EACH
def test_beats_uniform_in_fifty_dimensions(search, name):
    assert gain(name, played(named(search), name)[1]) > GAIN[search]


@pytest.mark.proves
@EACH
def test_is_not_much_worse_than_uniform_where_nothing_can_be_learned(search):
    if (search, "needle") in POINTLESS:
        pytest.skip("gradients say nothing here")
    assert gain("needle", played(named(search), "needle")[1]) > 1 / 1.6


@pytest.mark.proves
@EACH
def test_goes_on_to_other_failures(search):
    u, value = played(named(search), "saddles")
    corners = [
        len({tuple(p) for p in np.round(points[rho < 0]).astype(int)})
        for points, rho in zip(u, value, strict=True)
    ]
    # The coordinates of a bandit know nothing of each other.
    assert np.mean(corners) >= (1.6 if search == "bandit" else 3)
    # And goes on failing: at random it would be one in a thousand. Descents end where they fail,
    # and begin anew elsewhere.
    least = 0.03 if search == "gradient" else 0.06
    assert np.mean(value[:, value.shape[1] // 2 :] < 0) > least


@pytest.mark.proves
@EACH
def test_never_stops_exploring(search):
    # A tenth of the last 480 points: over every seed's and coordinate's whole range.
    u, _ = played(named(search), "ball")
    late = u[:, -480:]
    assert np.all(late.min(axis=1) < 0.15)
    assert np.all(late.max(axis=1) > 0.85)


@pytest.mark.slow
def test_cross_entropy_explores_evenly():
    # The last two of sixteen rows.
    u, _ = played(named("cross_entropy"), "corner")
    late = u[:, -480:].reshape(SEEDS, 30, 16, 4)[:, :, -2:].reshape(SEEDS, 60, 4)
    assert np.all(np.abs(late.mean(axis=1) - 0.5) < 0.1)


@pytest.mark.proves
def test_learns_in_large_batches_too():
    _, (value,) = play(named("cross_entropy"), ("ball",), 512, 6, 4)
    failing = (value < 0).reshape(4, 6, 512).mean(axis=2)
    assert np.all(failing[:, 0] < 0.02)
    assert np.all(failing.max(axis=1) > 0.2)
