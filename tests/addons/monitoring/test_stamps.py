"""Sample times: their unit, holes, repetitions; what is left of a log that was cut, or of a bag."""

import json

import h5py
import netCDF4
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet

from verifai_jax import mtl
from verifai_jax.addons.monitoring.stamps import find_clock, scale_of
from verifai_jax.core.values.trace import Trace

TIMES = [0.0, 0.1, 0.2, 0.3]


def table(path, name, stamps, unit=None, x=(1, 2, 3, 4)):
    row = "" if unit is None else f"{unit},m\n"
    rows = "".join(f"{t},{v}\n" for t, v in zip(stamps, x, strict=True))
    path.write_text(f"{name},x\n{row}{rows}")
    return path


@pytest.mark.parametrize(
    ("name", "unit", "count"),
    [
        ("time", "ms", 100), ("time", "[ms]", 100), ("time [ms]", None, 100),
        ("time (us)", None, 10**5), ("Time_ms", None, 100), ("time_usec", None, 10**5),
        ("timeNs", None, 10**8), ("time", "Microseconds", 10**5), ("time.nanosec", None, 10**8),
        ("time [0.1 s]", None, 1), ("time (100 ms)", None, 1),
        ("time", "milliseconds since boot", 100),
        ("time (ms)", "ms", 100),
    ],
)  # fmt: skip
def test_the_unit_of_a_clock_is_used(tmp_path, name, unit, count):
    path = table(tmp_path / "a.csv", name, [k * count for k in range(4)], unit)
    np.testing.assert_allclose(mtl.read(path).times, TIMES, rtol=1e-15)


def test_slow_clocks_and_clocks_that_began_long_ago(tmp_path):
    path = table(tmp_path / "a.csv", "time [min]", [0, 0.5, 1, 1.5])
    np.testing.assert_allclose(mtl.read(path).times, [0, 30, 60, 90])
    path = table(tmp_path / "a.csv", "time", ["0", "0.25", "0.5", "0.75"], "h")
    np.testing.assert_allclose(mtl.read(path).times, [0, 900, 1800, 2700])
    begin = 1_700_000_000_000
    path = table(tmp_path / "a.csv", "time_ms", [begin + 100 * k for k in range(4)])
    np.testing.assert_allclose(mtl.read(path).times, TIMES)


@pytest.mark.parametrize(
    ("name", "unit", "step", "words"),
    [
        ("time", None, 10_000_000, "is not known, which in seconds would be 115 d"),
        ("time", None, 10, "is not known, which in seconds would be 10 s apart"),
        ("time", None, 3333.5, "is not known, which in seconds would be 55 min"),
        ("time", "ticks", 1, "'ticks' is no unit of the sample times"),
        ("time [frames]", None, 1, "'frames' is no unit"),
        ("time_ms", "us", 1, "'us' and 'ms' are both given"),
    ],
)
def test_a_clock_of_unknown_unit_is_asked_for(tmp_path, name, unit, step, words):
    path = table(tmp_path / "a.csv", name, [k * step for k in range(4)], unit)
    with pytest.raises(ValueError, match=words) as raised:
        mtl.read(path)
    assert 'time_unit="ms"' in str(raised.value)
    trace = mtl.read(path, time_unit="us")
    np.testing.assert_allclose(trace.times, np.arange(4) * step * 1e-6)
    assert "is not known" in mtl.judge("x > 0", path).rows[0].error or unit or "[" in name
    assert mtl.judge("x > 0", path, time_unit="us").rows[0].verdict == "holds"


def test_units_in_attributes_of_files(tmp_path):
    stamps = np.arange(4) * 100
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["time"], file["x"] = stamps.astype(">i4"), np.arange(4.0).astype(">f8")
        file["time"].attrs["units"] = b"ms"
    schema = pa.schema([pa.field("time", pa.int64(), metadata={"units": "ms"}), ("x", pa.int64())])
    parquet.write_table(
        pa.table({"time": stamps, "x": range(4)}, schema=schema), tmp_path / "a.parquet"
    )
    since = "milliseconds since 2020-1-1 0:0:0"
    for name, unit in (("a.nc", since), ("b.nc", "ms"), ("c.nc", "milliseconds")):
        with netCDF4.Dataset(tmp_path / name, "w") as file:
            file.createDimension("time", 4)
            time = file.createVariable("time", "i8", ("time",))
            time[:], time.units = stamps, unit
            gap = file.createVariable("x", "f8", ("time",))
            gap[:], gap.units = [0, 1, 2, 3], "seconds"
    for name in ("a.h5", "a.parquet", "a.nc", "b.nc", "c.nc"):
        trace = mtl.read(tmp_path / name)
        np.testing.assert_allclose(trace.times, TIMES, err_msg=name)
        np.testing.assert_array_equal(trace["x"], range(4))


def test_what_a_unit_says():
    assert scale_of("days since 1970-01-02 06:00").origin == 86400 * 1.25
    assert scale_of("months since 2000-01-01") is scale_of("UTC") is None
    assert find_clock(["Time [ms]", "x"], "time") == "Time [ms]"
    assert find_clock(["time_ms", "time_us"], "time") is None


def test_clocks_that_differ_by_rounding_are_one(tmp_path):
    for origin in (0.0, 1.7e9):
        one = table(tmp_path / "1.csv", "time", [repr(origin + k * 0.1) for k in range(4)])
        two = tmp_path / "2.csv"
        ones = [repr(float(np.nextafter(origin + k / 10, 2e9))) for k in range(4)]
        two.write_text("time,y\n" + "".join(f"{t},{k}\n" for k, t in enumerate(ones)))
        trace = mtl.read([one, two])
        assert trace.length == 4
        (row,) = mtl.judge("always x == y + 1", trace).rows
        assert (row.verdict, row.error) == ("holds", "")


def test_a_hole_is_a_note_or_an_error(tmp_path):
    stamps = [*np.arange(20) / 10, *(np.arange(20) / 10 + 60)]
    path = tmp_path / "a.csv"
    path.write_text("time,x\n" + "".join(f"{t:.1f},1\n" for t in stamps))
    hole = "signal 'x' has no value from 1.9 s to 60 s, 58.1 s, where 0.1 s is usual"
    found = mtl.judge("always x > 0", path)
    assert found.rows[0].note == hole
    assert hole in str(found)
    assert "more than max_gap, which is 5 s" in mtl.judge("x > 0", path, max_gap=5.0).rows[0].error
    with pytest.raises(ValueError, match="more than max_gap"):
        mtl.read(path, max_gap=5.0)
    begin = pd.date_range("2024-03-31 01:59:58", periods=20, freq="100ms")
    local = [t + pd.Timedelta("1h") if k >= 10 else t for k, t in enumerate(begin)]
    assert "an hour is skipped" in str(mtl.read(pd.DataFrame({"time": local, "x": 1.0})).notes)


def test_a_time_that_comes_again_counts_twice(tmp_path):
    path = table(tmp_path / "a.csv", "time", [0.0, 0.1, 0.1, 0.2], x=(0, 5, -5, 0))
    for formula in ("always x > -4", "always x < 4", "eventually[0.1,0.1] x > 4"):
        (row,) = mtl.judge(formula, path).rows
        assert row.verdict == ("holds" if "eventually" in formula else "fails"), formula
        assert "both count, in their order" in row.note
    path = table(tmp_path / "a.csv", "time", [0.0, 0.2, 0.1, 0.3])
    with pytest.raises(ValueError, match=r"row 2 has 0\.2 s and row 3 0\.1 s$"):
        mtl.read(path)


def test_the_rest_of_a_log_that_was_cut_is_read(tmp_path):
    path = tmp_path / "a.csv"
    rows = "time,x,on\n0,1,true\n0.1,-,false\n0.2,2,true\n"
    for end in ("0.3", "0.3,4", "0.3,4,tr", "0.3,4,tr\0\0\0", "0.3,"):
        path.write_text(rows + end)
        trace = mtl.read(path)
        assert (trace.length, trace.is_truth("on")) == (3, True), end
        assert "was cut, and is left out" in str(trace.notes)
        np.testing.assert_array_equal(trace["x"], [1, np.nan, 2])


def test_a_late_answer_does_not_pass():
    req, ack = np.full(8, -0.5), np.full(8, -0.5)
    req[2], ack[6] = 0.5, 0.5
    times = np.array([0, 0.1, 0.21, 0.3, 0.4, 0.5, 0.59, 0.7])
    trace = Trace({"req": req, "ack": ack}, times=times)
    formula = "always (req > 0 -> eventually[0,0.3] ack > 0)"
    for options in ({}, {"resample_to": 0.1, "method": "hold"}):
        (row,) = mtl.judge(formula, trace, **options).rows
        assert (row.verdict, row.robustness, row.instant) == ("fails", -0.5, 0.21)
    counts = "always (req > 0 -> (next next next ack > 0))"
    assert "not evenly sampled" in mtl.judge(counts, trace).rows[0].error
    (row,) = mtl.judge(counts, trace, resample_to=0.1, method="hold").rows
    assert "up to 0.09 s later than the clock of 0.1 s" in row.note


def test_a_robustness_has_the_unit_of_the_recording():
    trace = Trace({"speed": np.array([50.0, 90.0])}, dt=0.1, units={"speed": "km/h"})
    limit = mtl.Requirement("limit", mtl.parse("always speed < 80"), unit="m/s")
    found = mtl.judge([limit], trace)
    assert found.rows[0].unit == "km/h"
    assert found.rows[0].note == (
        "its robustness is in km/h as recorded, and the requirement says m/s"
    )
    assert "-10 km/h" in str(found)
    assert found.rows[0].note in str(found)


def write_bag(path, stamps, bad=()):
    writer = pytest.importorskip("mcap.writer")
    with open(path, "wb") as file:
        out = writer.Writer(file)
        out.start()
        schema = out.register_schema("Speed", "jsonschema", b"{}")
        channels = {n: out.register_channel(f"/{n}", "json", schema) for n in ("a", "b")}
        for k, stamp in enumerate(stamps):
            for name, channel in channels.items():
                data = b"{torn" if (name, k) in bad else json.dumps({"x": float(stamp)}).encode()
                out.add_message(channel, int(stamp * 1e9), data, 0)
        out.finish()


def test_one_bad_topic_does_not_spoil_the_bag(tmp_path):
    write_bag(tmp_path / "a.mcap", TIMES, bad={("b", k) for k in range(4)} | {("a", 1)})
    trace = mtl.read(tmp_path / "a.mcap")
    np.testing.assert_array_equal(trace["a.x"], [0, 0.2, 0.3])
    notes = str(trace.notes)
    assert "4 messages of topic /b cannot be decoded, and left out: JSONDecodeError" in notes
    assert "1 message of topic /a cannot be decoded" in notes
    data = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "b.mcap").write_bytes(data[: len(data) // 2])
    assert "is damaged or was cut: only its first" in str(mtl.read(tmp_path / "b.mcap").notes)
    (tmp_path / "b.mcap").write_bytes(data[:30])
    with pytest.raises(ValueError, match=r"b\.mcap cannot be read"):
        mtl.read(tmp_path / "b.mcap")


def test_two_messages_at_one_time_both_count(tmp_path):
    write_bag(tmp_path / "a.mcap", [0, 1, 1.0000000001, 2])
    trace = mtl.read(tmp_path / "a.mcap")
    assert "both count" in str(trace.notes)
    assert np.isfinite(trace["a.x"]).sum() == 4


def test_a_bag_in_several_files_is_one_drive(tmp_path):
    for folder, first, second in (("bag", [0, 1], [2, 3]), ("logs", [0, 1], [1.5, 3])):
        (tmp_path / folder).mkdir()
        write_bag(tmp_path / folder / "bag_0.mcap", first)
        write_bag(tmp_path / folder / "bag_1.mcap", second)
        found = mtl.judge("always a.x < 2.5", tmp_path)
        assert found.rows[-1].file == str(tmp_path / folder)
        assert (found.rows[-1].verdict, found.rows[-1].instant) == ("fails", 3.0)
        assert mtl.read(tmp_path / folder).length == 4
    write_bag(tmp_path / "logs" / "bag_1.mcap", [60, 61])
    assert len(mtl.judge("always a.x < 2.5", tmp_path / "logs").files) == 2
