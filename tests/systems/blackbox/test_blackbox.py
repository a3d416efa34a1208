import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

from verifai_jax.core.values.trace import Trace
from verifai_jax.systems.blackbox import blackbox
from verifai_jax.systems.blackbox._blackbox import stack_traces


def test_features_arrive_as_plain_values():
    seen = {}

    def simulate(features):
        seen.update(features)
        return Trace({"x": np.ones(3)}, dt=0.1)

    system = blackbox(simulate)
    trace = system({"a": jnp.float32(0.5), "n": np.int32(2), "v": jnp.ones(2), "s": "red"}, None)
    assert system.black_box
    assert trace.length == 3
    assert type(seen["a"]) is float
    assert type(seen["n"]) is int
    assert type(seen["v"]) is np.ndarray
    assert seen["s"] == "red"


def test_seed_is_a_function_of_the_key():
    system = blackbox(lambda f, seed: Trace({"seed": np.array([seed])}, dt=1.0), seeded=True)
    seeds = [int(system({}, jax.random.key(i))["seed"][0]) for i in (0, 0, 1)]
    assert seeds[0] == seeds[1] != seeds[2]
    assert int(system({}, 7)["seed"][0]) == 7


def test_refuses_what_cannot_be_called():
    message = r"needs a function \(features\) -> Trace; got 3"
    with unchecked(), pytest.raises(ValueError, match=message):
        blackbox(3)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("declared", "match"),
    [
        ({"signals": ("x", "y")}, r"have the signals x, y; got x, v \(y missing; v not expected\)"),
        ({"signals": {"x": 1, "v": 3}}, r"signal 'v' must be \[time, 3\]; got \[5, 2\]"),
        ({"signals": {"x": 2, "v": 2}}, r"signal 'x' must be \[time, 2\]; got \[5\]"),
        (
            {"signals": ("x", "v")},
            r"\[time\]; got \[5, 2\]; declare .*signals={'v': 2, ...}",
        ),
        ({"dt": 0.2}, "must have the sampling period dt=0.2; got dt=0.1"),
        ({"length": 6}, "must have 6 samples; got 5"),
    ],
)
def test_a_trace_that_is_not_as_declared(declared, match):
    def simulate(features):
        return Trace({"x": np.ones(5), "v": np.ones((5, 2))}, dt=0.1)

    with pytest.raises(ValueError, match=match):
        blackbox(simulate, **declared)({})
    system = blackbox(simulate, signals={"v": 2, "x": 1}, dt=0.1, length=5)
    assert system({}).length == 5
    form = system.abstract({})
    assert {name: leaf.shape for name, leaf in form.signals.items()} == {"x": (5,), "v": (5, 2)}
    assert blackbox(simulate).abstract({}) is None


def test_a_period_is_not_sample_times():
    system = blackbox(lambda f: Trace({"x": np.ones(2)}, times=np.array([0.0, 0.1])), dt=0.1)
    with pytest.raises(ValueError, match=r"period dt=0\.1; it has sample times"):
        system({})


def test_a_trace_holds_numbers():
    system = blackbox(lambda f: Trace({"x": np.array(["a"])}, dt=0.1))
    refused = pytest.raises(TypeError, match="signal 'x' must hold real numbers; got <U1")
    with unchecked(), refused:
        system({})


def falling(features, seeds):
    a = np.asarray(features["a"])
    x = a[:, None] - np.arange(4.0)
    return stack_traces({"x": x, "v": np.stack([x, x], axis=2)}, dt=0.5, valid=seeds % 4 + 1)


def test_vectorised_is_many_single_ones():
    system = blackbox(falling, seeded=True, vectorised=True, signals={"x": 1, "v": 2})
    keys = jax.random.split(jax.random.key(0), 3)
    features = {"a": np.array([1.0, 2.0, 3.0])}
    batch = system.simulate_batch(features, keys)
    assert np.shape(batch["v"]) == (3, 4, 2)
    for i in range(3):
        one = system({"a": features["a"][i]}, keys[i])
        row = jax.tree.map(lambda leaf, i=i: leaf[i], batch)
        np.testing.assert_array_equal(one["x"], features["a"][i] - np.arange(4.0))
        np.testing.assert_array_equal(row["x"], one["x"])
        np.testing.assert_array_equal(row["v"], one["v"])
        assert int(row.valid) == int(one.valid) == int(jax.random.bits(keys[i])) % 4 + 1
        assert row.dt == 0.5


@pytest.mark.parametrize(
    ("trace", "match"),
    [
        (Trace({"x": np.ones(7)}, dt=1.0), r"shape \[3, time\] or \[3, time, k\].*got \[7\]"),
        (Trace({"x": np.ones((2, 7))}, dt=1.0), r"got \[2, 7\]"),
        (
            stack_traces({"x": np.ones((3, 7))}, dt=1.0, valid=np.ones(2, int)),
            r"valid of a vectorised black box must have shape \[3\]; got \[2\]",
        ),
        (stack_traces({"x": np.ones((3, 7))}, dt=2.0), r"period dt=1\.0; got dt=2\.0"),
    ],
)
def test_vectorised_refuses_other_shapes(trace, match):
    system = blackbox(lambda features: trace, vectorised=True, dt=1.0)
    with pytest.raises(ValueError, match=match):
        system.simulate_batch({"a": np.ones(3)}, jax.random.split(jax.random.key(0), 3))


def test_stacked_refuses_what_a_trace_refuses():
    with pytest.raises(ValueError, match="signals must have one length"):
        stack_traces({"x": np.ones((3, 7)), "y": np.ones((3, 6))}, dt=1.0)
