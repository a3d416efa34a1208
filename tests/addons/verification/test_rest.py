"""What is proved has probability zero, takes no simulation, and may be a set of parameters."""

import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons.verification.boxes import BROKEN, OUTSIDE, PROVED
from verifai_jax.addons.verification.rest import Rest


def squares(spec="always x <= 1.8", where=None, factor=1.0):
    """Return a problem that fails where `a + b^2 > 1.8`, whatever the load is."""

    def system(f, key):
        return vj.Trace({"x": (f["a"] + factor * f["b"] ** 2) * jnp.ones(3)}, dt=1.0)

    domains = {"a": vj.Box(0, 1), "b": vj.Box(-1, 1), "load": vj.Normal(1.0, 0.1)}
    return vj.Problem("squares", vj.FeatureSpace(domains, where), system, spec)


B = np.linspace(-1, 1, 400_001)


def failing_share(limit, b=B):
    return float(np.mean(np.clip(b**2 + 1 - limit, 0, 1)))


@pytest.fixture(scope="module")
def proved():
    return vj.verify(squares(), boxes=150, samples=0, progress=False)


@pytest.mark.slow
def test_a_point_is_in_the_rest_unless_its_box_is_decided(proved):
    """Points find their boxes by cuts as by comparing them with each box."""
    boxes, random = proved.boxes, np.random.default_rng(0)
    for states in ((PROVED,), (PROVED, BROKEN), ()):
        rest = Rest(boxes, states)
        decided = np.isin(boxes.state, states)
        assert rest.decided == boxes.mass[decided].sum()
        assert rest.mass + rest.decided == pytest.approx(1.0, abs=1e-15)
        points = random.random((3000, 3))
        within = np.all((boxes.low <= points[:, None]) & (points[:, None] < boxes.high), axis=2)
        assert np.array_equal(rest.is_decided(points), (within & decided).any(axis=1))
        assert not rest.is_decided(rest.draw(random, 3000)).any()
    middle = (boxes.low + boxes.high)[boxes.state == PROVED] / 2
    rest = Rest(boxes, (PROVED,))
    assert rest.is_decided(middle, 2.0**-20).all()
    assert np.asarray(rest.is_decided(jnp.asarray(middle), 2.0**-20, jnp)).all()
    corner = boxes.low[(boxes.state == PROVED) & (boxes.low > 0).any(axis=1)]
    assert not rest.is_decided(corner, 2.0**-20).any()


@pytest.mark.thorough
def test_an_estimate_counts_nothing_where_it_is_proved(proved):
    found = vj.estimate(squares(), "monte_carlo", 2000, proved=proved, progress=False)
    truth = failing_share(1.8)
    assert found.certain == proved.throughout.mass
    assert found.rest == pytest.approx(1 - proved.proved.mass - found.certain, abs=1e-12)
    assert found.low <= truth <= found.high <= found.certain + found.rest
    assert found.high - found.low < 0.1 * found.certain
    assert found.probability == found.certain + found.rest * found.failures / 2000
    assert found.upper_bound < 1.1 * truth
    assert found.simulations_until(found.certain + found.rest) == 0
    text = str(found)
    assert "that fails for certain" in text
    assert "independent samples of this rest alone" in text


@pytest.mark.slow
def test_a_rare_failure_is_counted_in_what_a_proof_leaves():
    """Of one in four million, a hundred samples of the rest say more than splitting does."""
    problem = squares("always x <= 1.999")
    proved = vj.verify(problem, boxes=400, samples=0, progress=False)
    found = vj.estimate(problem, "monte_carlo", 2000, proved=proved, progress=False)
    truth = failing_share(1.999, np.linspace(0.999, 1, 400_001)) * 0.001
    assert found.low <= truth <= found.high < 1.3 * truth


@pytest.mark.slow
def test_with_a_constraint_the_probability_is_that_of_what_it_accepts():
    problem = squares(where=lambda f: f["b"] > 0.3)
    proved = vj.verify(problem, boxes=250, samples=0, progress=False)
    assert (proved.boxes.state == OUTSIDE).any()
    found = vj.estimate(problem, "monte_carlo", 2000, proved=proved, progress=False)
    truth = failing_share(1.8, B[B > 0.3])
    assert found.low <= truth <= found.high < 1.2 * found.low


@pytest.mark.thorough
def test_what_is_proved_as_a_whole_needs_no_simulation():
    problem = squares("always x <= 3")
    proved = vj.verify(problem, boxes=20, samples=0, progress=False)
    found = vj.estimate(problem, proved=proved, p0=1e-9, progress=False)
    assert found.simulations == 0
    assert (found.probability, found.interval, found.upper_bound) == (0.0, (0.0, 0.0), 0.0)
    assert str(found) == "squares: fails with probability 0, as all of the prior is decided"
    with pytest.raises(ValueError, match="all of 'squares' is proved: nothing is left to search"):
        vj.falsify(problem, vj.Start(proved=proved))


@pytest.mark.slow
def test_a_run_simulates_nothing_that_is_proved(proved, tmp_path):
    run = vj.falsify(
        squares(), vj.Start("uniform", proved=proved), 200, folder=tmp_path, progress=False
    )
    rest = Rest(proved.boxes, (PROVED,))
    points = np.asarray(squares().space.points(run.table.all), float)
    assert not rest.is_decided(points, 2.0**-20).any()
    assert np.sum(run.table.all["violated"]) > 0.5 * 200
    assert "of the prior is proved and not simulated; all rates are of the rest" in str(run)
    more = vj.resume(tmp_path, proved.rest(squares()), budget=300, progress=False)
    assert len(more.table) == 300


@pytest.mark.slow
def test_a_search_begins_where_bounds_are_loosest():
    """A needle of a share of 3e-6: its box has the lowest bound, and a search of it takes long."""

    def system(f, key):
        far = ((f["x"] - 0.3127) ** 2 + (f["y"] - 0.6841) ** 2) / 1e-6
        ripple = 0.06 * jnp.sin(40 * f["x"]) * jnp.sin(40 * f["y"])
        return vj.Trace({"m": (0.05 + ripple - 5 * jnp.exp(-far)) * jnp.ones(2)}, dt=1.0)

    space = {"x": vj.Box(0, 1), "y": vj.Box(0, 1)}
    problem = vj.Problem("needle", space, system, "always m >= -0.02")
    found = vj.verify(problem, boxes=20, samples=0, progress=False)
    assert 0.5 < found.proved.mass < 1
    counts = []
    begun = vj.Start("cross_entropy", proved=found)
    for one, search in ((problem, begun), (found.rest(problem), "cross_entropy")):
        run = vj.falsify(one, search, 8192, batch=64, stop=vj.Stop(after=1), seed=0, progress=False)
        counts.append(len(run.table) if run.table.all["violated"].any() else 10**9)
    assert counts[0] <= 64 < 1024 < counts[1]


@pytest.mark.thorough
def test_a_proof_of_another_problem_proves_nothing(proved):
    for other, what in ((squares(factor=1.01), "model"), (squares("always x <= 2"), "formulas")):
        with pytest.raises(ValueError, match=f"verification is of another problem: its {what}"):
            proved.rest(other)
    with pytest.raises(ValueError, match="its precision was 'float32', and is 'float64' now"):
        vj.estimate(squares(), proved=proved, precision="float64")


@pytest.mark.slow
def test_parameters_are_proved_as_a_set():
    """The formula holds for all `w` where `1.25 + 0.1 d^2 <= gain <= 2.5 - 0.1 d^2`."""

    def system(f, key):
        gain, w = f["gain"], f["w"]
        margin = jnp.minimum(gain - 1 - w**2, 3 - jnp.abs(w) - gain) - 0.1 * f["d"] ** 2
        return vj.Trace({"margin": margin * jnp.ones(3)}, dt=1.0)

    space = {"gain": vj.Box(0, 5), "w": vj.Box(-0.5, 0.5), "d": vj.Box(-1, 1),
             "kind": vj.Categorical("a", "b")}  # fmt: skip
    problem = vj.Problem("gains", space, system, "always margin >= 0")
    found = vj.synthesize(
        problem, ["gain", "d", "kind"], 600, aim=vj.Aim(held_out=0), prove=4, seed=1, progress=False
    )
    assert found.proved is not None
    (low, high), (least, greatest) = found.proved.ends["gain"], found.proved.ends["d"]
    reach = 0.1 * max(least**2, greatest**2)
    assert 1.25 + reach <= low < high <= 2.5 - reach
    assert low <= found.parameters["gain"] <= high
    assert (high - low) * (greatest - least) > 1.0
    kind = found.parameters["kind"]
    assert found.proved.ends["kind"] == (kind, kind)
    share = (high - low) / 5 * (greatest - least) / 2 / 2
    assert found.proved.mass == pytest.approx(share, rel=1e-4)
    assert f"proved: no simulation fails with gain in {low:.6g} to" in str(found)


def test_a_system_that_draws_is_refused_before_anything_is_searched():
    import jax

    system = lambda f, key: vj.Trace({"x": f["x"] + jax.random.normal(key, (3,))}, dt=1.0)  # noqa: E731
    problem = vj.Problem("noise", {"x": vj.Box(0, 1)}, system, "always x > 0")
    with pytest.raises(vj.ProblemError, match="'noise' draws random numbers"):
        vj.synthesize(problem, prove=5)
