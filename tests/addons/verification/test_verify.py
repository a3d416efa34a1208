"""What is proved has no failure, what is broken has one, and the parts sum to one."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons.verification.enclosure import Enclosure
from verifai_jax.addons.verification.sets import MissingRule
from verifai_jax.core.messages.text import format_percent
from verifai_jax.core.store.files import DamagedError


def decay(spec="always x <= 1", **space):
    def system(f, key):
        steps = jnp.arange(6.0)
        return vj.Trace({"x": f["a"] * jnp.exp(-f["rate"] * steps) + f["b"] ** 2}, dt=1.0)

    domains = {"a": vj.Box(0, 1), "b": vj.Box(-1, 1), "rate": vj.Normal(1.0, 0.1)} | space
    return vj.Problem("decay", domains, system, spec)


@pytest.fixture(scope="module")
def verified():
    return vj.verify(decay(), boxes=600, samples=512, progress=False)


@pytest.mark.thorough
def test_parts_sum_to_one_and_contain_the_truth(verified):
    """The failing set is `a + b^2 > 1`, of probability `1 - 2/3` under the prior."""
    for share in ("mass", "volume"):
        parts = [getattr(part, share) for part in (
            verified.proved, verified.broken, verified.undecided
        )]  # fmt: skip
        assert sum(parts) == pytest.approx(1.0, abs=1e-6)
    assert verified.boxes.mass.sum() == 1.0
    assert verified.throughout.mass <= 1 / 3 <= 1 - verified.proved.mass
    assert verified.proved.mass > 0.6
    assert verified.throughout.mass > 0.28
    low, high = verified.probability
    assert low <= 1 / 3 <= high < 0.4


@pytest.mark.thorough
def test_every_box_says_what_holds_in_it(verified):
    boxes = verified.boxes
    random = np.random.default_rng(0)
    rows = random.choice(len(boxes), 4000, p=boxes.mass)
    u = boxes.low[rows] + random.random((4000, 3)) * (boxes.high[rows] - boxes.low[rows])
    fails = u[:, 0] + (2 * u[:, 1] - 1) ** 2 > 1
    words = verified.verdicts[rows]
    assert not fails[words == "proved"].any()
    assert fails[boxes.state[rows] == 2].all()
    for row in np.flatnonzero(verified.verdicts == "broken"):
        point = boxes.witness[row]
        assert point[0] + (2 * point[1] - 1) ** 2 > 1
        assert np.all((boxes.low[row] <= point) & (point <= boxes.high[row]))


@pytest.mark.thorough
def test_the_text_says_what_is_verified(verified):
    text = str(verified)
    assert text.startswith(f"decay: {100 * verified.proved.mass:.3g} % of the prior is proved, ")
    assert "in real arithmetic and with the rounding of float32; no differential equation" in text
    assert "by 512 samples" in text
    assert "<img" in verified._repr_html_()
    table = verified.table
    assert list(table.columns[:3]) == ["verdict", "throughout", "mass"]
    assert table["mass"].is_monotonic_decreasing
    assert set(table["verdict"]) == {"proved", "broken", "undecided"}
    assert (table.loc[table["verdict"] == "proved", "failure_bound"] == 0).all()


@pytest.mark.thorough
def test_a_report_says_what_is_proved_and_what_not(verified, tmp_path):
    path = verified.report(tmp_path / "decay.html", problem=decay(), units={"a": "m"})
    text, claims = path.read_text(), json.loads((tmp_path / "decay.claims.json").read_text())
    share = format_percent(verified.proved.mass)
    sentences = [claim["claim"] for claim in claims["claims"]]
    assert sentences[0] == f"No simulation fails in {share} of the prior."
    assert sentences[2].endswith("contain a point that fails for certain.")
    assert claims["about"]["result"] == "verification"
    assert f"{share} of the prior is proved" in text
    assert "rate from" in text
    assert "no differential equation" in text
    assert "data:image/png" in text


@pytest.mark.thorough
def test_a_result_is_saved_read_and_gone_on_with(verified, tmp_path):
    path = verified.save(tmp_path / "decay.json")
    again = vj.load_verification(path)
    assert str(again) == str(verified)
    assert again.table.equals(verified.table)
    more = vj.verify(decay(), boxes=200, samples=0, resume=path, progress=False)
    assert more.looked_at == verified.looked_at + 200
    assert more.proved.mass > verified.proved.mass
    with pytest.raises(ValueError, match=r"its formulas was .*x <= 1.* and is .*x <= 2.* now"):
        vj.verify(decay("always x <= 2"), resume=path)
    path.write_text(path.read_text().replace('"seconds": ', '"seconds": 1'))
    with pytest.raises(DamagedError, match="its content has changed"):
        vj.load_verification(path)


@pytest.mark.thorough
def test_at_exactly_zero_the_comparison_decides():
    """A clipped number reaches its limit: `<=` holds there, `<` does not."""

    def system(f, key):
        return vj.Trace({"u": jnp.clip(3 * f["x"], -1, 1) * jnp.ones(2)}, dt=1.0)

    for spec, proved in (("always u <= 1", 1.0), ("always u < 1", 0.0), ("eventually u > 1", 0.0)):
        problem = vj.Problem("limit", {"x": vj.Box(0.5, 1)}, system, spec)
        found = vj.verify(problem, boxes=20, samples=0, progress=False)
        assert found.proved.mass == proved


@pytest.mark.thorough
def test_choices_are_looked_at_one_by_one_and_a_constraint_leaves_boxes_out():
    def system(f, key):
        gain = jnp.asarray([1.0, -1.0, 0.5])[f["kind"]]
        return vj.Trace({"y": gain * f["x"] * f["n"] * jnp.ones(3)}, dt=1.0)

    space = vj.FeatureSpace(
        {"x": vj.Box(0, 1), "kind": vj.Categorical("up", "down", "half", weights=[0.5, 0.25, 0.25]),
         "n": vj.DiscreteBox(1, 4)}, where=lambda f: f["x"] > 0.25,
    )  # fmt: skip
    problem = vj.Problem("choices", space, system, "always y > 0")
    found = vj.verify(problem, boxes=700, samples=0, progress=False)
    assert found.proved.mass == pytest.approx(0.75, abs=0.02)
    assert found.throughout.mass == pytest.approx(0.25, abs=0.02)
    assert found.boxes.mass[found.verdicts == "outside"].sum() == pytest.approx(0.25, abs=0.01)


@pytest.mark.thorough
def test_an_array_of_varying_length_and_a_signal_are_features():
    def system(f, key):
        present = jnp.arange(2) < f["cars"].length
        near = jnp.min(jnp.where(present, f["cars"].values["x"], 50.0))
        wind = f["wind"](jnp.arange(5.0))
        return vj.Trace({"gap": near + wind}, dt=1.0)

    space = {"cars": vj.Array(vj.Struct({"x": vj.Box(10, 20)}), length=(1, 2)),
             "wind": vj.Signal(vj.Box(-1, 1), knots=2, hold="linear", duration=4.0)}  # fmt: skip
    problem = vj.Problem("cars", space, system, "always gap >= 11")
    found = vj.verify(problem, boxes=300, samples=0, progress=False)
    assert 0.3 < found.proved.mass < 0.81
    assert found.notes == ()


@pytest.mark.parametrize(
    ("options", "message"),
    [({"boxes": 0}, "boxes must be"),
     ({"box": 3}, "did you mean 'boxes'"), ({"confidence": 2}, "confidence must lie")],
)  # fmt: skip
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        vj.verify(decay(), **options)


def test_what_cannot_be_verified_is_an_error_that_says_why():
    import jax

    random = vj.Problem(
        "noise", {"x": vj.Box(0, 1)},
        lambda f, key: vj.Trace({"x": f["x"] + jax.random.normal(key, (3,))}, dt=1.0),
        "always x > 0",
    )  # fmt: skip
    with pytest.raises(
        vj.ProblemError, match=r"'noise' draws random numbers.*make these numbers features"
    ):
        vj.verify(random)
    box = vj.Problem(
        "host",
        {"x": vj.Box(0, 1)},
        vj.blackbox(lambda x: {"x": np.zeros(3)}, dt=1.0),
        "always x > 0",
    )
    with pytest.raises(vj.ProblemError, match="'host' has a system that JAX does not trace"):
        vj.verify(box)
    next_ones = vj.Problem(
        "next", {"x": vj.Box(0, 1)},
        lambda f, key: vj.Trace({"x": jnp.nextafter(f["x"] * jnp.ones(3), 2.0)}, dt=1.0),
        "always x > 0",
    )  # fmt: skip
    with pytest.raises(MissingRule, match="sets cannot go through the operation nextafter"):
        vj.verify(next_ones, boxes=1, progress=False)


def corner(f, key):
    inside = jnp.maximum(jnp.maximum(jnp.abs(f["x"] - f["px"]), jnp.abs(f["y"] - f["py"])),
                         jnp.abs(f["z"] - f["pz"]))  # fmt: skip
    return vj.Trace({"away": (inside - 5e-4) * jnp.ones(2)}, dt=1.0)


@pytest.mark.thorough
def test_a_failing_corner_of_a_billionth_is_in_no_proved_box():
    """Two hundred places of a cube of side 0.001, and boxes of all sizes around each of them."""
    names = ["x", "y", "z", "px", "py", "pz"]
    problem = vj.Problem("corner", {n: vj.Box(0, 1) for n in names}, corner, "always away >= 0")
    enclosure = Enclosure(problem, "float32")
    random = np.random.default_rng(0)
    place = random.uniform(0.1, 0.9, (200, 3)).astype(np.float32).astype(float)
    point = place + random.uniform(-4.9e-4, 4.9e-4, (200, 3))
    for exponent in range(1, 24, 2):
        width = 2.0**-exponent
        low = np.floor(point / width) * width
        bounds = enclosure(np.concatenate([low, place], 1), np.concatenate([low + width, place], 1))
        assert not bounds.holds.any()
        assert np.all(bounds.low < 0)


@pytest.mark.thorough
def test_a_branch_and_bound_never_proves_the_corner_away():
    space = {n: vj.Box(0, 1) for n in "xyz"} | {
        n: vj.Constant(v) for n, v in (("px", 0.3), ("py", 0.7), ("pz", 0.11))
    }
    problem = vj.Problem("corner", space, corner, "always away >= 0")
    found = vj.verify(problem, boxes=1500, samples=1000, progress=False)
    point = np.array([0.3, 0.7, 0.11])
    around = np.all((found.boxes.low <= point) & (point <= found.boxes.high), axis=1)
    assert not np.any(around & (found.verdicts == "proved"))
    assert 0.9 < found.proved.mass < 1 - 0.5e-9


@pytest.mark.thorough
def test_sines_of_this_package_are_as_tight_as_those_of_jax():
    def system(f, key):
        sine, cosine = vj.sin_cos(20 * f["x"])
        return vj.Trace({"y": sine + cosine * jnp.ones(2)}, dt=1.0)

    problem = vj.Problem("angle", {"x": vj.Box(-1, 1)}, system, "always y <= 2")
    low = np.linspace(0, 0.99, 100)[:, None]
    bounds = Enclosure(problem, "float32")(low, low + 0.01)
    angle = 20 * (2 * (low + 0.01 * np.linspace(0, 1, 50)) - 1)
    rho = 2 - np.sin(angle) - np.cos(angle)
    assert np.all(bounds.low <= rho.min(1) + 1e-6)
    assert np.all(bounds.high >= rho.max(1) - 1e-6)
    assert np.max(rho.min(1) - bounds.low) < 0.03


@pytest.mark.thorough
def test_what_may_not_be_finite_is_not_proved():
    """A simulation without a verdict is not a counterexample, and no proof either."""

    def system(f, key):
        x = jnp.exp(f["x"] * jnp.arange(4.0))
        return vj.Trace({"x": x, "y": jnp.ones(4)}, dt=1.0)

    problem = vj.Problem("growth", {"x": vj.Box(0, 40)}, system, "always (y > 0 & x > 0)")
    found = vj.verify(problem, boxes=60, samples=64, progress=False)
    limit = np.log(3.4e38) / 3 / 40
    assert found.proved.mass == pytest.approx(limit, abs=0.01)
    assert found.proved.mass <= limit
    assert found.broken.mass == 0
    assert found.probability[1] > 0.2
