import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.mtl import robustness


def test_hold_repeats_the_last_valid_sample():
    trace = Trace({"x": jnp.arange(5.0), "p": jnp.arange(10.0).reshape(5, 2)}, dt=0.1, valid=3)
    held = trace.hold()
    assert held.signals["x"].tolist() == [0, 1, 2, 2, 2]
    assert held.signals["p"][:, 1].tolist() == [1, 3, 5, 5, 5]
    assert held.held
    assert held.hold() is held


def test_trim_keeps_the_valid_part():
    trace = Trace({"x": jnp.arange(5.0)}, times=jnp.arange(5.0) ** 2, valid=jnp.array(2))
    assert trace.trim().signals["x"].tolist() == [0, 1]
    assert trace.trim().clock().tolist() == [0, 1]
    assert trace.clock().tolist() == [0, 1, 4, 9, 16]


def test_clock_counts_periods():
    np.testing.assert_allclose(Trace({"x": np.zeros(3)}, dt=0.5).clock(), [0, 0.5, 1.0])


def test_a_batch_of_traces_is_a_trace_of_batches():
    def simulate(x):
        return Trace({"x": x + jnp.arange(4.0)}, dt=1.0, valid=jnp.array(2), status=jnp.int32(0))

    batch = jax.vmap(simulate)(jnp.array([0.0, 10.0]))
    assert batch.signals["x"].shape == (2, 4)
    held = jax.vmap(Trace.hold)(batch)
    assert held.signals["x"].tolist() == [[0, 1, 1, 1], [10, 11, 11, 11]]
    assert batch.dt == 1.0


def test_signals_keep_the_order_written():
    trace = Trace({"x": np.zeros(2), "a": np.ones(2), "m": np.ones((2, 3))}, dt=1.0)
    again = jax.jit(lambda t: t)(trace)
    assert list(again.signals) == ["x", "a", "m"]
    assert again.signals["m"].shape == (2, 3)
    names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(trace)]
    assert names == ["['x']", "['a']", "['m']"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"signals": {}, "dt": 1.0}, "at least one signal; got none"),
        ({"signals": {"x": np.zeros(0)}, "dt": 1.0}, "got signals of length 0"),
        ({"signals": {"x": np.zeros(3), "y": np.zeros(4)}, "dt": 1.0}, "got x: 3, y: 4"),
        ({"signals": {"x": np.zeros((2, 2, 2))}, "dt": 1.0}, r"'x' must have shape .* \[2, 2, 2\]"),
        ({"signals": {"x": np.zeros(3)}}, "either a sampling period dt or sample times"),
        ({"signals": {"x": np.zeros(3)}, "dt": 1.0, "times": np.arange(3)}, "give one"),
        ({"signals": {"x": np.zeros(3)}, "dt": 0.0}, "dt must be positive; got 0.0"),
        ({"signals": {"x": np.zeros(3)}, "times": np.arange(4)}, r"shape \[3\].* got \[4\]"),
    ],
)
def test_bad_traces_are_refused(arguments, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        Trace(**arguments)


@pytest.mark.parametrize(
    ("notes", "message"),
    [
        (["fell back"], "notes must be counts by text.*got list"),
        ({5: 1}, "got the text 5"),
        ({"fell back": "often"}, "count of note 'fell back' must be an integer.*'often'"),
        ({"fell back": -1}, "count of note 'fell back' must be an integer of at least 0"),
    ],
)
def test_notes_are_counts_by_text(notes, message):
    with unchecked(), pytest.raises((TypeError, ValueError), match=message):
        Trace({"x": np.zeros(3)}, dt=1.0, notes=notes)


def test_status_codes_are_stable():
    # They are stored in tables on disk.
    assert [(s.name, s.value) for s in Status] == [
        ("OK", 0),
        ("NONFINITE", 1),
        ("ERROR", 2),
        ("TIMEOUT", 3),
    ]


def test_text_is_short_and_never_an_array():
    signals = {"x": jnp.linspace(-1, 2, 201), "pose": np.zeros((201, 3)), "on": np.ones(201, bool)}
    trace = Trace(signals, dt=0.02, valid=11, status=1)
    assert repr(trace) == (
        "Trace(x, pose, on; 201 samples every 0.02 s, of which 11 count, status nonfinite)"
    )
    assert str(trace).splitlines() == [
        "trace of 201 samples every 0.02 s, of which 11 count, status nonfinite",
        "  x     -1 to -0.85",
        "  pose  [3]  0",
        "  on    true in 100% of the samples",
    ]
    assert "0 s to 2 s" in repr(Trace({"x": np.array([1.0, np.nan])}, times=np.array([0.0, 2.0])))
    batch = jax.vmap(lambda a: Trace({"x": a * jnp.ones(5)}, dt=0.1, valid=3))(jnp.ones(4))
    forms = jax.eval_shape(lambda: trace)
    for other in (batch, forms):
        assert len(str(other)) < 300
    jax.jit(lambda t: (str(t), repr(t), t.hold())[-1])(trace)


@pytest.mark.parametrize(
    ("wrong", "error", "said"),
    [
        ({"dt": np.inf}, ValueError, "finite number of seconds"),
        ({"dt": 1e-320}, ValueError, "finite number of seconds"),
        ({"valid": 0}, ValueError, "from 1 to 3"),
        ({"valid": 4}, ValueError, "from 1 to 3"),
        ({"valid": np.float64(1.5)}, ValueError, "how many samples"),
        ({"status": 7}, ValueError, "status must be one of 0 \\(OK\\)"),
        ({"signals": {"x": np.ones(3) * 1j}}, TypeError, "must hold real numbers; got complex128"),
    ],
)
def test_what_can_be_no_trace_is_refused_when_it_is_made(wrong, error, said):
    with unchecked(), pytest.raises(error, match=said):
        Trace(**{"signals": {"x": np.ones(3)}, "dt": 0.1, **wrong})


@pytest.mark.thorough
def test_wide_integers_of_the_host_do_not_wrap():
    x = np.full(4, 2**40 + 5)
    assert robustness("always x > 6", Trace({"x": x}, dt=0.1, valid=3)) == np.float32(2.0**40)
    assert robustness("x > 6", Trace({"x": x.astype(np.uint64)}, dt=0.1)) > 0
