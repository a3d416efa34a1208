"""Sample times from any origin: judged in double precision, by what the stamps can tell apart."""

import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.core.messages.text import format_time
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import SamplingError, explain, read, resample, robustness, satisfied
from verifai_jax.mtl.setting import period

ORIGINS = [0.0, 0.3, 1e3, 86_400.0, 1.7e9, 2.0**40]


def trace_at(times, x=None):
    return Trace({"x": np.zeros(len(times)) if x is None else np.asarray(x)}, times=times)


@pytest.mark.parametrize("origin", ORIGINS)
def test_uneven_samples_are_refused_from_every_origin(origin):
    uneven = trace_at(origin + np.array([0, 1, 2, 58, 59, 60.0]), [0, 0, 0, 1, 1, 1.0])
    with pytest.raises(SamplingError, match=r"steps of 1 s to 56 s, as at \d+(\.\d+)? s"):
        robustness("F[0,36] (x > 0.5)", uneven)
    late = origin + 0.1 * np.arange(50)
    late[25] += 0.01
    with pytest.raises(SamplingError):
        robustness("G (x < 0.5)", trace_at(late))
    held = resample(uneven, 1.0, "hold")
    assert robustness("F[0,36] (x > 0.5)", held) == -0.5
    assert robustness("F[0,58] (x > 0.5)", held) == 0.5


@pytest.mark.parametrize("origin", ORIGINS)
@pytest.mark.parametrize("dt", [1.0, 0.25, 0.1, 0.02, 0.01, 1 / 3, 1 / 30, 1 / 60])
@pytest.mark.parametrize("count", [2, 3, 100])
def test_the_period_is_the_one_that_was_meant(origin, dt, count):
    times = origin + dt * np.arange(count)
    assert period(trace_at(times)) == pytest.approx(dt, rel=1e-12)


def test_single_precision_is_as_good_as_it_is():
    near = (100 + 0.1 * np.arange(30)).astype(np.float32)
    assert period(trace_at(near)) == 0.1
    assert period(trace_at(jnp.asarray(np.arange(300) / 30, jnp.float32))) == pytest.approx(1 / 30)
    with pytest.raises(ValueError, match=r"are float32 numbers, .* give them in double precision"):
        period(trace_at((1.7e9 + 0.1 * np.arange(30)).astype(np.float32)))
    with pytest.raises(ValueError, match=r"do not tell a period of .* whose spacing is 0\.00781 s"):
        period(trace_at((86_400 + 0.02 * np.arange(30)).astype(np.float32)))


def test_integer_stamps_are_exact():
    assert period(trace_at(np.array([-128, 127], np.int8))) == 255
    nanoseconds = np.array([1, 2, 3], np.int64) + 2**62
    assert period(trace_at(nanoseconds)) == 1.0
    with pytest.raises(ValueError, match="sample times must increase"):
        period(trace_at(np.array([3, 2, 1], np.uint64)))


def test_clocks_keep_their_stamps():
    stamps = 1.7e9 + 0.1 * np.arange(30)
    assert len(set(trace_at(stamps).clock().tolist())) == 30
    assert np.diff(Trace({"x": np.zeros(3)}, dt=1e-3).clock()).tolist() == [1e-3, 1e-3]
    assert "from 1700000000 s to 1700000002.9 s" in repr(trace_at(stamps))


def test_instants_are_written_so_that_they_differ():
    assert [format_time(t) for t in (0.1 + 0.2, 12.5, 999.0)] == ["0.3", "12.5", "999"]
    assert format_time(86_400.02) == "86400.02"
    assert format_time(1.7e9 + 0.1) == "1700000000.1"
    assert format_time(2.0**40 + 0.1) == "1099511627776.1"
    assert format_time(np.inf) == "inf"
    trace = trace_at(1.7e9 + 0.5 * np.arange(4), [0, 1, 2, np.nan])
    with pytest.raises(ValueError, match=r"signal 'x' is NaN at 1700000001\.5 s"):
        satisfied("G x < 5", trace)
    why = explain("G[0,1] x < 1.5", trace)
    assert why.time == 1.7e9 + 1
    assert "at 1700000001 s" in str(why)


def test_files_keep_their_stamps(tmp_path):
    rows = [f"{1_700_000_000 + t},{float(k > 2)}" for k, t in enumerate((0, 1, 2, 58, 59, 60))]
    (tmp_path / "log.csv").write_text("\n".join(["time,x", *rows]))
    with pytest.raises(SamplingError):
        robustness("F[0,36] (x > 0.5)", read(tmp_path / "log.csv"))
