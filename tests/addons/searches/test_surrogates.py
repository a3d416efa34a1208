"""A model of the traces in place of a slow black box: proposals, resuming, the default search."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons.searches.trace_form import TraceForm
from verifai_jax.addons.searches.trace_model import spread_factor
from verifai_jax.addons.searches.trace_surrogate import Surrogate, TraceSurrogate, padded_rows
from verifai_jax.addons.searches.turbo import TuRBO
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.evaluation.host_engine import HostEngine
from verifai_jax.falsification import simulations
from verifai_jax.mtl import parse, robustness

DIM = 6
SMALL = TraceSurrogate(initial=6, starts=4, steps=8)


def oscillator(features):
    """A damped oscillator under a force of six pieces, in NumPy."""
    x, v, xs = 0.0, 0.0, [0.0]
    for force in np.repeat(features["force"], 20):
        v += 0.1 * (force - 0.2 * v - x - 0.2 * x**3)
        x += 0.1 * v
        xs.append(x)
    return vj.Trace({"x": np.array(xs), "late": np.arange(len(xs)) > 60}, dt=0.1)


def problem(system=oscillator, formula="always x < 2.1", **options):
    space = {"force": vj.Array(vj.Box(-1, 1), length=DIM)}
    return vj.Problem("oscillator", space, vj.blackbox(system, **options), formula)


def first_failure(run):
    failing = np.flatnonzero(run.table.all["violated"])
    return int(failing[0]) + 1 if len(failing) else len(run.table.all) + 1


@pytest.mark.proves
def test_needs_half_of_the_simulations_of_others():
    rare = problem()
    needed = {
        name: np.median(
            [
                first_failure(
                    vj.falsify(
                        rare, name, 200, batch=8, seed=s, stop=vj.Stop(after=1), progress=False
                    )
                )
                for s in range(5)
            ]
        )
        for name in ("trace_surrogate", "bayes")
    }
    assert 2 * needed["trace_surrogate"] <= needed["bayes"]


@pytest.mark.slow
def test_resumed_it_proposes_the_same(tmp_path):
    options = {"batch": 8, "seed": 3, "progress": False}
    whole = vj.falsify(problem(), SMALL, 32, **options)
    vj.falsify(problem(), SMALL, 24, folder=tmp_path / "run", **options)
    resumed = vj.resume(tmp_path / "run", problem(), budget=32, progress=False)
    assert whole.table.all.equals(resumed.table.all)
    # The model did propose: what it learned from is in the checkpoint.
    assert len(whole.checkpoint["surrogate.rho"]) == 32


@pytest.mark.slow
def test_rows_without_a_trace_and_of_other_lengths_are_simulated_as_well():
    def odd(features):
        trace = oscillator(features)
        if features["force"][0] > 0.8:
            raise RuntimeError("no solution")
        if features["force"][1] > 0.5:  # Ended early.
            return vj.Trace({n: s[:50] for n, s in trace.signals.items()}, dt=0.1)
        return trace

    run = vj.falsify(problem(odd, "always (late -> x < 2.1)"), SMALL, 32, batch=8, progress=False)
    table = run.table.all
    assert len(table) == 32
    assert (table["status"] == "error").any()
    assert len(run.checkpoint["surrogate.rho"]) == (table["status"] == "ok").sum()


def traced_oscillator(features, key):
    """The same oscillator in JAX, with a signal that no formula speaks of."""

    def step(state, force):
        x, v = state
        v += 0.1 * (force - 0.2 * v - x - 0.2 * x**3)
        x += 0.1 * v
        return (x, v), x

    _, xs = jax.lax.scan(step, (0.0, 0.0), jnp.repeat(features["force"], 20))
    xs = jnp.concatenate([jnp.zeros(1), xs])
    return vj.Trace({"x": xs, "late": jnp.arange(121) > 60, "other": xs**2}, dt=0.1)


def traced_problem(system=traced_oscillator, formula="always (late -> x < 2.1)"):
    space = {"force": vj.Array(vj.Box(-1, 1), length=DIM)}
    return vj.Problem("oscillator", space, system, formula)


def test_compiled_systems_keep_the_monitored_signals():
    u = np.random.default_rng(1).random((5, DIM)).astype(np.float32)
    traces = Evaluator(traced_problem(), 4, keep_traces=True)(u).traces
    assert traces is not None
    for point, trace in zip(u, traces, strict=True):
        expected = oscillator({"force": 2 * point - 1}).signals
        assert set(trace.signals) == {"x", "late"}
        np.testing.assert_allclose(trace.signals["x"], expected["x"], atol=1e-4)
        np.testing.assert_array_equal(trace.signals["late"], expected["late"])
    assert Evaluator(traced_problem(), 4)(u).traces is None


@pytest.mark.slow
def test_a_system_that_jax_traces_is_learned_as_a_black_box_is():
    run = vj.falsify(
        traced_problem(), SMALL, 64, batch=8, seed=1, progress=False, stop=vj.Stop(after=1)
    )
    assert run.search.startswith("TraceSurrogate(")
    assert len(run.table.counterexamples)
    assert len(run.checkpoint["surrogate.rho"]) == len(run.table.all)
    assert 0 < run.search_seconds < run.run_seconds
    assert "s to search, " in str(run)


@pytest.mark.slow
def test_where_no_traces_come_it_is_turbo():
    space = {"force": vj.Array(vj.Box(-1, 1), length=DIM)}
    spec = {"low": "always x < 2.1", "high": "always x > -2.1"}
    ranked = vj.Problem("ranked", space, traced_oscillator, spec, priority=["low", "high"])
    run = vj.falsify(ranked, SMALL, 8, batch=8, progress=False)
    assert run.search.startswith("TuRBO(")
    assert "search turbo: trace_surrogate knows no priority" in run.notes
    assert isinstance(SMALL.fallback, TuRBO)


def test_one_of_six_proposals_is_the_guess_of_the_model_whatever_the_batch(monkeypatch):
    """Where all were, a model that is wrong was never left: half of the runs found nothing."""
    for batch in (1, 2, 8):
        guesses, count = [], 0

        def propose(self, count, guess, batch=batch, guesses=guesses):
            guesses.append((count, guess))
            return np.full((count, DIM), 0.5, np.float32)

        monkeypatch.setattr(Surrogate, "_proposals", propose)
        surrogate = Surrogate(problem(), SMALL, jax.random.key(0))
        surrogate.rho = np.ones(SMALL.initial, np.float32)
        surrogate.traces = np.eye(SMALL.initial, dtype=np.float32)
        for _ in range(64 // batch):
            surrogate.improve(np.zeros((batch, DIM), np.float32))
        count = sum(count for count, _ in guesses)
        assert count == 48
        assert sum(guess for _, guess in guesses) == 8


class TestDefault:
    @pytest.mark.slow
    def test_quick_black_boxes_have_the_portfolio(self):
        calls = []

        def counted(features):
            calls.append(1)
            return oscillator(features)

        options = {"budget": 40, "seed": 5, "progress": False}
        default = vj.falsify(problem(counted), **options)
        # Measured ones are rows; what is claimed is simulated once more.
        assert len(calls) == 40 + len(default.table.counterexamples)
        named = vj.falsify(problem(), "portfolio", **options)
        assert default.search == named.search
        assert default.table.all.equals(named.table.all)
        assert default.notes == named.notes

    @pytest.mark.slow
    def test_slow_ones_a_model_and_resume_keeps_it(self, tmp_path, monkeypatch):
        # The clock is not asked: as if each simulation took as long as it takes to be slow.
        monkeypatch.setattr(simulations, "SLOW", 0.0)
        monkeypatch.setattr("verifai_jax.falsification.validation.SLOW", 0.0)
        run = vj.falsify(
            problem(),
            budget=16,
            stop=vj.Stop(after=100),
            seed=2,
            folder=tmp_path / "run",
            progress=False,
        )
        assert run.search.startswith("TraceSurrogate(")
        assert run.batch == 8
        assert any(note.startswith("search trace_surrogate: a simulation") for note in run.notes)
        monkeypatch.undo()
        resumed = vj.resume(tmp_path / "run", problem(), budget=24, progress=False)
        assert resumed.search == run.search
        assert any(
            note.startswith("search trace_surrogate: a simulation") for note in resumed.notes
        )
        # The measured rows are those that a portfolio would have begun with.
        begun = vj.falsify(problem(), "portfolio", 16, seed=2, progress=False).table.all
        first = [c for c in begun if c.startswith("force")]
        np.testing.assert_array_equal(resumed.table.all[first][:1], begun[first][:1])

    @pytest.mark.slow
    def test_it_can_be_set(self, monkeypatch):
        monkeypatch.setattr("verifai_jax.falsification.validation.SLOW", 0.0)
        run = vj.falsify(problem(), "portfolio", 8, progress=False)
        assert run.search.startswith("Portfolio(")


def test_traces_in_the_form_of_the_model():
    rng = np.random.default_rng(0)
    form = TraceForm((("p", 2), ("x", 0)), 0.1, 100)
    trace = vj.Trace({"x": rng.normal(size=100), "p": rng.normal(size=(100, 2))}, dt=0.1)
    again = form.trace(jnp.asarray(form.flat(trace)))
    for name, signal in trace.signals.items():
        np.testing.assert_allclose(again.signals[name], signal, atol=1e-5)
    # A longer one keeps every so many samples, those between on straight lines.
    form = TraceForm((("x", 0),), 0.1, 1001)
    smooth = np.sin(np.arange(1001) / 60)
    again = form.trace(jnp.asarray(form.flat(vj.Trace({"x": smooth}, dt=0.1))))
    assert again.length == 1001
    np.testing.assert_allclose(again.signals["x"], smooth, atol=1e-3)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("formula", "stride"),
    [
        ("always[0, 50] x > -2", 25),
        ("always[0, 72] eventually[0, 8] x > -2", 25),
        ("always[0.04, 60] x > -2", 4),
        ("always x > -2", 25),
        ("always (x > -2 | next x > 0)", 1),
    ],
)
def test_the_monitor_sees_of_a_long_trace_what_the_windows_need(formula, stride):
    whole = parse(formula)
    form = TraceForm.of((("x", 0),), 0.01, 10_001, [whole])
    assert form.stride == stride
    smooth = np.sin(np.arange(10_001) / 900) * np.linspace(1, 2, 10_001)
    trace = vj.Trace({"x": smooth}, dt=0.01)
    seen = form.trace(jnp.asarray(form.flat(trace)))
    assert seen.length == 10_000 // stride + 1
    np.testing.assert_allclose(seen.signals["x"], smooth[::stride], atol=2e-3)
    np.testing.assert_allclose(robustness(whole, seen), robustness(whole, trace), atol=1e-2)


def test_short_traces_are_monitored_at_every_sample():
    for length in (1, 2, 25, 257, 401, 511):
        form = TraceForm.of((("x", 0),), 0.1, length, [parse("always x > 0")])
        assert form.stride == 1


def test_a_model_without_progress_is_believed_less():
    better = 0.8 ** np.arange(20)
    assert {spread_factor(better, number, 2) for number in range(8)} == {1.0}
    idle = np.append(better, np.ones(64))
    spreads = [spread_factor(idle, number, 2) for number in range(8)]
    np.testing.assert_allclose(spreads, 2 * [4 ** (i / 3) for i in range(4)])
    # A little better is no progress, and the factor is bounded.
    little = np.append(better, better[-1] * 0.999 ** np.arange(1, 33))
    assert spread_factor(little, 3, 2) == pytest.approx(2)
    assert spread_factor(np.ones(1000), 3, 2) == pytest.approx(5)
    # In more dimensions progress takes longer.
    assert spread_factor(idle, 3, 4) == pytest.approx(2)
    # Nobody has to leave a failure.
    assert spread_factor(np.append(-1.0, np.ones(100)), 3, 2) == 1


def test_the_best_rows_from_which_points_are_drawn_are_no_neighbours():
    surrogate = Surrogate(problem(), SMALL, jax.random.key(0))
    hollow = 0.5 + 0.02 * np.random.default_rng(0).random((40, DIM))
    others = np.linspace(0, 0.3, 3)[:, None] * np.ones(DIM)
    surrogate.u = np.concatenate([hollow, others]).astype(np.float32)
    surrogate.rho = np.arange(43, dtype=np.float32)
    np.testing.assert_array_equal(surrogate._parents(), surrogate.u[[0, 40, 41, 42]])


@pytest.mark.parametrize("capacity", [16, 512, 5000])
def test_programs_are_compiled_for_few_numbers_of_rows_whatever_the_capacity(capacity):
    sizes = [padded_rows(rows, capacity) for rows in range(1, capacity + 1)]
    assert all(size >= rows for rows, size in enumerate(sizes, 1))
    assert max(sizes) == capacity
    assert len(set(sizes)) <= 5


@pytest.mark.thorough
@pytest.mark.parametrize("vectorised", [False, True])
def test_an_engine_that_keeps_traces(vectorised):
    def many(features):
        rows = [oscillator({"force": row}) for row in features["force"]]
        signals = {n: np.stack([row.signals[n] for row in rows]) for n in rows[0].signals}
        return vj.stack_traces(signals, dt=0.1)

    what = problem(many, vectorised=True) if vectorised else problem()
    u = np.random.default_rng(1).random((3, DIM)).astype(np.float32)
    engine = HostEngine(what, keep_traces=True)
    verdicts = engine.evaluate(u, jax.random.key(0))
    assert verdicts.traces is not None
    for point, trace in zip(u, verdicts.traces, strict=True):
        expected = oscillator({"force": 2 * point - 1}).signals["x"]
        np.testing.assert_allclose(trace.signals["x"][: len(expected)], expected, atol=1e-4)
    assert HostEngine(what).evaluate(u, jax.random.key(0)).traces is None
