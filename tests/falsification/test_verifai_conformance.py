"""What VerifAI 2.2 does, case by case: what is worth keeping is kept, what was wrong is right.

The cases of searches, analyses and the rulebook are in their own tests (`ce_compat`, `grid`,
`halton`, `table`, `rulebook`); `docs/from_verifai.md` lists the decisions.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj


class TestFeatures:
    """Cases domain-01 to domain-06."""

    SPACE = vj.FeatureSpace(
        {
            "arr": vj.Array(vj.Array(vj.Box(0, 1), length=2), length=2),
            "b": vj.Categorical("red", "green"),
            "k": vj.Constant(7),
            "n": vj.DiscreteBox(1, 3),
            "z": vj.Box([0, 2], [1, 4]),
        }
    )

    @pytest.mark.thorough
    def test_columns_and_round_trip(self):
        point = {"z": [0.25, 3.0], "b": "green", "n": 2, "arr": [[0.0, 0.1], [0.2, 0.3]]}
        features = self.SPACE.coerce(point)
        batch = jax.tree.map(lambda leaf: np.asarray(leaf)[None], features)
        row = {name: column[0] for name, column in self.SPACE.rows(batch).items()}
        assert list(row) == [
            "arr[0][0]", "arr[0][1]", "arr[1][0]", "arr[1][1]", "b", "n", "z[0]", "z[1]",
        ]  # fmt: skip
        assert row["b"] == "green"
        numbers = [value for name, value in row.items() if name != "b"]
        np.testing.assert_allclose(numbers, [0, 0.1, 0.2, 0.3, 2, 0.25, 3.0], rtol=1e-6)
        back = self.SPACE.unflatten(self.SPACE.flatten(features))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), back, features)
        assert self.SPACE.dim == 8
        assert self.SPACE.ordered == (True,) * 4 + (False,) + (True,) * 3

    def test_which_coordinates_are_continuous(self):
        two = vj.Categorical("x", "y")
        levels = {
            vj.Box([0, 0], [1, 1]): (0, 0),
            vj.DiscreteBox(2, 5): (4,),
            vj.Categorical("a", "b", "c"): (3,),
            vj.Constant(1): (),
            vj.Array(vj.Box(0, 1), length=3): (0, 0, 0),
            vj.Array(two, length=2): (2, 2),
            vj.Struct({"a": vj.Box(0, 1), "b": vj.DiscreteBox(0, 1)}): (0, 2),
        }
        for domain, expected in levels.items():
            assert domain.levels == expected

    def test_intervals(self):
        box = vj.Box.from_intervals((3, 1), (0, 10))
        assert box == vj.Box([1, 0], [3, 10])
        np.testing.assert_allclose(box.to_unit([1.5, 2.5]), [0.25, 0.25])
        np.testing.assert_allclose(box.from_unit(jnp.array([0.25, 0.25])), [1.5, 2.5])
        assert vj.Box.from_intervals((3, 1)) == vj.Box(1, 3)
        assert vj.DiscreteBox.from_intervals((0.2, 3.9)) == vj.DiscreteBox(1, 3)
        with pytest.raises(ValueError, match="low must be below high"):
            vj.Box(3, 1)
        with unchecked(), pytest.raises(ValueError, match="an interval is a pair of numbers"):
            vj.Box.from_intervals(3)  # pyright: ignore[reportArgumentType]

    def test_order_is_the_one_written(self):
        names = ["param2", "param10", "a", "B"]
        assert vj.FeatureSpace({n: vj.Box(0, 1) for n in names}).columns == tuple(names)

    def test_a_constraint_that_nothing_satisfies(self):
        space = vj.FeatureSpace({"x": vj.Box(0, 1)}, where=lambda f: f["x"] > 2)
        problem = vj.Problem("never", space=space, system=shifted, spec="x > 0.5")
        with pytest.raises(ValueError, match="accepted none of"):
            vj.falsify(problem)


def shifted(features, key):
    return vj.Trace({"x": features["x"][None]}, dt=1.0)


class TestFalsifier:
    """Cases fals-01 to fals-03: `x > 0.5` has robustness x - 0.5 and is broken at 0.5."""

    PROBLEM = vj.Problem("shift", {"x": vj.Box(0, 1)}, shifted, "x > 0.5")

    def test_tables_and_interval(self):
        table = vj.falsify(self.PROBLEM, "halton", 8, batch=8, confirm=False).table
        failing, safe = (t[["x", "rho"]].to_numpy() for t in (table.counterexamples, table.safe))
        np.testing.assert_allclose(
            failing, [[0.5, 0], [0.25, -0.25], [0.125, -0.375], [0.375, -0.125], [0.0625, -0.4375]]
        )
        np.testing.assert_allclose(safe, [[0.75, 0.25], [0.625, 0.125], [0.875, 0.375]])
        rate = vj.clopper_pearson(5, 8)
        np.testing.assert_allclose((rate.low, rate.high), (0.24486321636655, 0.91476658586264))

    def test_stops_simulating_at_the_wanted_number(self):
        run = vj.falsify(self.PROBLEM, "halton", 8, batch=1, stop=vj.Stop(after=2), confirm=False)
        assert (run.simulations, len(run.table.counterexamples), len(run.table.safe)) == (2, 2, 0)

    def test_a_margin_of_zero_counts_where_the_comparator_says_so(self):
        loose = vj.Problem("shift", {"x": vj.Box(0, 1)}, shifted, "x >= 0.5")
        assert vj.falsify(self.PROBLEM, "halton", 1, batch=1).table.all["violated"].tolist() == [1]
        assert vj.falsify(loose, "halton", 1, batch=1).table.all["violated"].tolist() == [0]


class TestMonitor:
    """Cases mtl-01, mtl-02, mtl-05 to mtl-07."""

    TRACE = vj.Trace({"a": np.array([3.0, -1, 2, 5]), "b": np.array([-2.0, 4, 0.5, -3])}, dt=0.1)

    @pytest.mark.parametrize(
        ("formula", "expected"),
        [
            ("a >= 0", 3.0),
            ("not a >= 0", -3.0),
            ("(a >= 0) & (b >= 0)", -2.0),
            ("(a >= 0) | (b >= 0)", 3.0),
            ("a >= 0 -> b >= 0", -2.0),
            ("(a >= 0) <-> (b >= 0)", -2.0),
            ("always a >= 0", -1.0),
            ("eventually b >= 0", 4.0),
            ("always ((a >= 0) | (b >= 0))", 2.0),
            ("eventually ((a >= 0) & (b >= 0))", 0.5),
            ("always eventually a >= 0", 5.0),
            ("eventually always a >= 0", 5.0),
            ("always (a >= 0 -> eventually b >= 0)", -3.0),
            ("next a >= 0", -1.0),
        ],
    )
    def test_values(self, formula, expected):
        assert float(vj.robustness(formula, self.TRACE)) == pytest.approx(expected)

    def test_windows(self):
        # Closed, as the standard has it; `compat` reproduces the half-open ones.
        ramp = vj.Trace({"c": np.arange(8.0)}, dt=1.0)
        cases = {"eventually[0, 1]": (1, 0), "eventually[1, 3]": (3, 2), "always[1, 3]": (1, 1)}
        for operator, (closed, half_open) in cases.items():
            formula = f"{operator} c >= 0"
            assert float(vj.robustness(formula, ramp)) == closed
            assert float(vj.robustness(formula, ramp, compat="pymtl")) == half_open

    @pytest.mark.parametrize(
        ("a", "b", "expected"),
        [
            ([-1], [-5], -5),
            ([-10, -10, -10], [-10, -10, 0.5], -10),
            ([2, -4, 2], [-3, -3, 1], -3),
            ([2, 2, 2], [-3, -3, 1], 1),
        ],
    )
    def test_until(self, a, b, expected):
        trace = vj.Trace({"a": np.array(a, float), "b": np.array(b, float)}, dt=1.0)
        assert float(vj.robustness("(a >= 0) until (b >= 0)", trace)) == expected

    def test_small_margins_hold(self):
        assert bool(vj.mtl.satisfied("eventually ((a >= 0) & (b >= 0))", self.TRACE))

    def test_unbalanced(self):
        with pytest.raises(vj.FormulaSyntaxError):
            vj.parse("eventually (not (x >= 0) | not (y >= 0)")


class TestCartPole:
    """Case cartpole-01: Euler steps of the cart-pole under a bang-bang law."""

    CASES = (
        ([0.0, 0.05, 0.1, 0.5], [0.01660967, 0.00035384, 0.00446536, -0.00781407], 0.16943951),
        ([1.5, -0.08, 0.2, 0.3], [-0.02544088, 0.0149504, 0.01309477, -0.29991175], 0.08240629),
        ([-1.9, 0.1, 0.25, 0.75], [-0.13627, -0.01912301, -0.01027364, 0.12711539], -0.01106887),
        ([1.9, 0.09, 0.06, 0.7], [13.2093239, 17.9227031, 19.4852709, 5.66383544], -19.26583139),
    )

    @pytest.mark.thorough
    def test_traces_and_robustness(self):
        def dynamics(time, state, force, f):
            _, speed, angle, rate = state
            total = 1 + f["masspole"]
            pushed = (force + f["masspole"] * f["length"] * rate**2 * jnp.sin(angle)) / total
            inertia = f["length"] * (4 / 3 - f["masspole"] * jnp.cos(angle) ** 2 / total)
            turned = (9.8 * jnp.sin(angle) - jnp.cos(angle) * pushed) / inertia
            slid = pushed - f["masspole"] * f["length"] * turned * jnp.cos(angle) / total
            return jnp.stack([speed, slid, rate, turned])

        def law(time, state, f):
            return jnp.where(jnp.array([0.1, 0.2, 1.0, 0.25]) @ state > 0, 10.0, -10.0)

        with jax.enable_x64(True):
            loop = vj.ode(
                dynamics,
                lambda f, key: jnp.stack([f["x"], 0 * f["x"], f["theta"], 0 * f["x"]]),
                controller=law,
                dt=0.02,
                steps=200,
                method="euler",
                signals=lambda t, s, u, f: {"x": s[0], "theta": s[2], "last": s},
            )
            names = ("x", "theta", "masspole", "length")
            columns = np.array([case[0] for case in self.CASES]).T
            trace = jax.jit(jax.vmap(loop))(dict(zip(names, jnp.array(columns), strict=True)))
            limit = 12 * np.pi / 180 + 0.01
            spec = vj.parse(f"always (abs(x) <= 2.5 & abs(theta) <= {limit!r})")
            rho = jax.vmap(lambda t: vj.robustness(spec, t))(trace)
            for i, (_, last, robustness) in enumerate(self.CASES):
                np.testing.assert_allclose(trace.signals["last"][i, -1], last, rtol=1e-6, atol=1e-7)
                np.testing.assert_allclose(rho[i], robustness, rtol=1e-6)
