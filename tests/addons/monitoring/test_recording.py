"""Recorded traces: files, gaps, clocks, and what is refused."""

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from checked_types import unchecked
from pyarrow import parquet

from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import read, resample, robustness


@pytest.fixture
def flight(tmp_path):
    file = tmp_path / "flight.csv"
    file.write_text(
        "time,x,p[0],p[1],label,armed\n0.0,1.0,3,4,a,true\n0.1,2.0,0,0,b,false\n0.2,,1,1,c,true\n"
    )
    return file


def test_csv(flight):
    trace = read(flight)
    assert set(trace.signals) == {"x", "p", "armed"}
    assert trace["p"].shape == (3, 2)
    assert np.isnan(trace["x"][2])
    assert robustness("norm(p) > 4", trace) == 1.0
    assert robustness("F[0,0.1] (x > 0)", trace) == 2.0
    assert robustness("G[0,0.1] armed", trace) == -1.0
    assert set(read(flight, columns=["x"]).signals) == {"x"}


@pytest.mark.parametrize(
    "text",
    [
        "time;x\n0,0;1,5\n0,5;-2e0\n",
        "time;x\n0.0;1.5\n0.5;-2\n",
        "time\tx\n0.0\t1.5\n0.5\t-2\n",
        'time,x\n"0,0","1,5"\n"0,5","-2"\n',
    ],
)
def test_separators_and_decimal_commas(tmp_path, text):
    (tmp_path / "flight.csv").write_text(text)
    trace = read(tmp_path / "flight.csv")
    np.testing.assert_array_equal(trace.times, [0, 0.5])
    np.testing.assert_array_equal(trace["x"], [1.5, -2])


def test_parquet_and_a_given_period(tmp_path):
    file = tmp_path / "flight.parquet"
    parquet.write_table(pa.table({"x": [1.0, 2.0, 3.0]}), file)
    trace = read(file, dt=0.5)
    assert trace.dt == 0.5
    assert robustness("X (x > 0)", trace) == 2.0


def test_a_data_frame_is_read_as_the_file_of_its_rows(flight):
    from_file, frame = read(flight), pd.read_csv(flight)
    moments = frame.assign(time=pd.Timestamp("2026-01-01") + pd.to_timedelta(frame.time, unit="s"))
    for source in (frame, frame.set_index("time"), moments, moments.set_index("time")):
        trace = Trace.from_dataframe(source)
        assert list(trace.signals) == list(from_file.signals)
        np.testing.assert_allclose(trace.times, from_file.times, rtol=1e-12)
        for name, values in trace.signals.items():
            np.testing.assert_array_equal(values, from_file[name])
    assert Trace.from_dataframe(frame, dt=0.5).dt == 0.5


def test_bad_data_frames(flight):
    frame = pd.read_csv(flight)
    with pytest.raises(ValueError, match="the data frame has no column 'time' of sample times"):
        read(frame.drop(columns="time"))
    with pytest.raises(ValueError, match="the data frame has no rows"):
        read(frame[:0])
    with pytest.raises(ValueError, match="column 'label' of the data frame holds no numbers"):
        read(frame, columns=["label"])
    with pytest.raises(ValueError, match="the data frame has more than one column 'armed'"):
        read(frame.rename(columns={"x": "armed"}))
    with unchecked(), pytest.raises(TypeError, match=r"a file or a pandas\.DataFrame; got a list"):
        read([1.0])


DATES = ["2026-05-01T12:00:00", "2026-05-01T12:00:00.5", "2026-05-01T12:00:01"]


@pytest.mark.parametrize(
    "stamps",
    [
        DATES,
        [date + "Z" for date in DATES],
        [date + "+02:00" for date in DATES],
        [date.replace("T", " ") for date in DATES],
        ["12:00:00", "12:00:00.5", "12:00:01"],
    ],
)
def test_dates_in_files_are_seconds_since_the_first(tmp_path, stamps):
    rows = [f"{stamp},{x}" for stamp, x in zip(stamps, (1, 2, 3), strict=True)]
    (tmp_path / "log.csv").write_text("\n".join(["time,x", *rows]))
    table = pa.table({"time": stamps, "x": [1.0, 2, 3]})
    parquet.write_table(table, tmp_path / "text.parquet")
    parquet.write_table(
        table.set_column(0, "time", pa.array(pd.to_datetime(DATES, format="ISO8601"))),
        tmp_path / "date.parquet",
    )
    frame = pd.DataFrame({"time": stamps, "x": [1.0, 2, 3]})
    paths = [tmp_path / name for name in ("log.csv", "text.parquet", "date.parquet")]
    for source in (*paths, frame):
        trace = read(source)
        assert trace.times.tolist() == [0, 0.5, 1]
        assert robustness("F[0,1] x", trace) == 3


def test_durations_days_and_missing_dates(tmp_path):
    days = pa.table({"time": pd.to_datetime(["2026-05-01", "2026-05-03"]).date, "x": [1.0, 2.0]})
    parquet.write_table(days, tmp_path / "days.parquet")
    assert read(tmp_path / "days.parquet").times.tolist() == [0, 172_800]
    frame = pd.DataFrame({"time": pd.to_timedelta([1, 1.5], unit="s"), "x": [1.0, 2.0]})
    assert read(frame).times.tolist() == [0, 0.5]
    (tmp_path / "gap.csv").write_text(f"time,x\n{DATES[0]},1\n,2\n{DATES[2]},3\n")
    with pytest.raises(ValueError, match="sample times must be finite; row 2 has nan s"):
        read(tmp_path / "gap.csv")


def test_one_text_among_numbers_is_refused_by_its_row(tmp_path):
    (tmp_path / "log.csv").write_text("time,x,y\n0,1,1\n1,2,\n2,3,off\n3,n/a,1\n")
    frame = pd.DataFrame({"time": [0, 1], "y": pd.Series([1.0, "off"], dtype=object)})
    for source, row in ((tmp_path / "log.csv", 3), (frame, 2)):
        with pytest.raises(ValueError, match=f"column 'y' of .* holds 'off' in row {row}, where"):
            read(source, columns=["y"])
    trace = read(tmp_path / "log.csv")
    assert list(trace.signals) == ["x"]
    assert "column 'y' holds 'off' in row 3, where other rows hold numbers" in str(trace)
    with pytest.raises(UnknownNameError, match=r"no signal 'y'.*column 'y' holds 'off' in row 3"):
        robustness("G y > 0", trace)
    (tmp_path / "log.csv").write_text("time,x\n0,1\nlater,2\n")
    with pytest.raises(ValueError, match=r"column 'time' of .* holds 'later' in row 2"):
        read(tmp_path / "log.csv")


@pytest.mark.parametrize(
    "kind", [pa.list_(pa.float32()), pa.list_(pa.float32(), 2), pa.large_list(pa.int64())]
)
def test_columns_of_lists_are_vectors(tmp_path, kind):
    cells = [[1, 2], None, [3, 4]]
    times = np.array([0, 1, 2], np.float32)
    parquet.write_table(
        pa.table({"time": times, "state": pa.array(cells, kind)}), tmp_path / "a.parquet"
    )
    wanted = [[1, 2], [np.nan, np.nan], [3, 4]]
    np.testing.assert_array_equal(read(tmp_path / "a.parquet")["state"], wanted)
    frame = pd.DataFrame({"time": times, "state": [np.array([1.0, 2]), None, [3.0, 4]]})
    np.testing.assert_array_equal(read(frame)["state"], wanted)


def test_lists_that_make_no_vector_are_told(tmp_path):
    cells = {"a": [[1.0], [1.0, 2.0]], "b": [[[1.0]], [[2.0]]], "c": [["x"], ["y"]], "x": [1, 2]}
    parquet.write_table(pa.table({"time": [0, 1], **cells}), tmp_path / "a.parquet")
    trace = read(tmp_path / "a.parquet")
    assert list(trace.signals) == ["x"]
    assert sum(f"column {name!r} holds lists" in str(trace.notes) for name in "abc") >= 2
    with pytest.raises(ValueError, match=r"'a' of .* holds lists of different lengths \(1, 2\)"):
        read(tmp_path / "a.parquet", columns=["a"])
    with pytest.raises(ValueError, match=r"not vectors of numbers; in row 1 there is \[1\.0\]"):
        read(tmp_path / "a.parquet", columns=["b"])


def test_decimals_and_categories_are_numbers(tmp_path):
    table = pa.table({"time": [0, 1], "x": pa.array([1, 2], pa.decimal128(5, 2))})
    parquet.write_table(table, tmp_path / "a.parquet")
    assert read(tmp_path / "a.parquet")["x"].tolist() == [1, 2]
    frame = pd.DataFrame({"time": [0, 1], "x": pd.Categorical([3, 4])})
    assert read(frame)["x"].tolist() == [3, 4]


def test_resampling():
    trace = Trace({"x": np.array([0.0, 1.0, 3.0])}, times=np.array([1.0, 1.1, 1.4]))
    held = resample(trace, 0.1, "hold")
    assert held.dt == 0.1
    np.testing.assert_array_equal(held["x"], [0, 1, 1, 1, 3])
    linear = resample(trace, 0.1, "linear")
    np.testing.assert_allclose(linear["x"], [0, 1, 5 / 3, 7 / 3, 3])
    np.testing.assert_allclose(resample(trace, 0.15, "linear")["x"], [0, 4 / 3, 7 / 3])
    even = Trace({"x": np.arange(5.0), "on": np.arange(5) > 1}, dt=0.1, valid=4)
    half = resample(even, 0.2, "linear")
    np.testing.assert_allclose(half["x"], [0, 2])
    assert half["on"].dtype == bool
    gap = Trace({"x": np.array([0.0, 1.0, np.nan])}, dt=1.0)
    np.testing.assert_array_equal(resample(gap, 0.5, "linear")["x"], [0, 0.5, 1, np.nan, np.nan])


def test_bad_recordings(tmp_path, flight):
    def file(text, name="bad.csv"):
        path = tmp_path / name
        path.write_text(text)
        return path

    with pytest.raises(FileNotFoundError, match="there is no recording"):
        read(tmp_path / "none.csv")
    with pytest.raises(ValueError, match=r"\.csv, \.tsv, .*\.h5 or \.hdf5 file; got bad\.txt"):
        read(file("x\n1\n", "bad.txt"))
    with pytest.raises(ValueError, match="has no rows"):
        read(file("time,x\n"))
    with pytest.raises(ValueError, match=r"no column 'time' of sample times.*It has: t, x"):
        read(file("t,x\n0,1\n"))
    with pytest.raises(ValueError, match=r"row 2 has 0\.2 s and row 3 0\.1 s"):
        read(file("time,x\n0,1\n0.2,1\n0.1,1\n"))
    with pytest.raises(
        ValueError, match=r"column 'label' of .* holds no numbers; it starts with 'a'"
    ):
        read(flight, columns=["label"])
    with pytest.raises(UnknownNameError, match=r"flight\.csv has no column 'xx'; did you mean 'x'"):
        read(flight, columns=["xx"])
    with pytest.raises(ValueError, match="more than one column 'x'"):
        read(file("time,x,x\n0,1,2\n"))
    with pytest.raises(ValueError, match="Decimal commas need semicolons between the columns"):
        read(file("time,x\n0,0,1,5\n0,5,2,5\n"))
    with pytest.raises(ValueError, match="commas in column 'time' and decimal points in"):
        read(file("time;x\n0,0;1.5\n0,5;2.5\n"))
    with pytest.raises(ValueError, match="cannot be read"):
        read(file("not a table", "bad.parquet"))
    with pytest.raises(ValueError, match="resampling needs both"):
        read(flight, resample_to=0.1)
    trace = Trace({"x": np.ones(3)}, times=np.array([0.0, 0.1, 0.3]))
    with unchecked(), pytest.raises(ValueError, match="method is 'hold' or 'linear'; got 'cubic'"):
        resample(trace, 0.1, "cubic")
    with unchecked(), pytest.raises(ValueError, match="dt must be positive; got 0"):
        resample(trace, 0, "hold")


@pytest.mark.parametrize("dt", [1e-12, 1e-300, float("inf"), float("nan")])
def test_absurd_periods_are_refused_in_words(dt):
    with pytest.raises(ValueError, match=r"more than 100000000|sampling period dt"):
        resample(Trace({"x": np.arange(3.0)}, dt=1.0), dt, "hold")


def test_a_comma_that_may_stand_between_thousands_is_refused(tmp_path):
    path = tmp_path / "log.csv"
    for separator in (",", "\t"):
        path.write_text(f'time{separator}x\n0{separator}"1,500"\n1{separator}7\n')
        with pytest.raises(ValueError, match=r"has '1,500' in column 'x', whose comma may be"):
            read(path)
    path.write_text("time;x\n0;1,500\n1;7\n")
    assert np.asarray(read(path)["x"]).tolist() == [1.5, 7.0]
    path.write_text('time,x\n0,"1,500"\n1,"7,25"\n')
    assert np.asarray(read(path)["x"]).tolist() == [1.5, 7.25]


def test_comments_and_a_row_of_units_are_passed_over(tmp_path):
    file = tmp_path / "flight.csv"
    for text in (
        "# made by a logger\n# at noon\ntime,x\n0,1\n0.5,2\n",
        "time;x\ns;m\n0,0;1,0\n0,5;2,0\n",
        '# units below\n"time","x"\n"[s]",\n0,1\n0.5,2\n',
    ):
        file.write_text(text)
        trace = read(file)
        np.testing.assert_array_equal(trace.times, [0, 0.5])
        np.testing.assert_array_equal(trace["x"], [1, 2])
    file.write_text("time,x\n0,a\n0.5,2\n")
    with pytest.raises(ValueError, match="holds 'a' in row 1, where other rows hold numbers"):
        read(file, columns=["x"])


@pytest.mark.parametrize(("unit", "factor"), [("ms", 10**3), ("us", 10**6), ("ns", 10**9)])
def test_clocks_since_1970_are_recognised_and_said(tmp_path, unit, factor):
    file = tmp_path / "flight.csv"
    first = 1_700_000_000 * factor
    file.write_text(f"time,x\n{first},1\n{first + factor // 10},2\n{first + factor // 5},3\n")
    trace = read(file)
    np.testing.assert_array_equal(trace.times, [0.0, 0.1, 0.2])
    assert any(f"is read as {unit} since 1970" in note for note in trace.notes)
    file.write_text("time,x\n1700000000.5,1\n1700000001.5,2\n")
    assert not read(file).notes


def test_arrays_of_numpy(tmp_path):
    file = tmp_path / "flight.npz"
    np.savez(file, time=np.arange(3) * 0.5, x=np.arange(3.0), p=np.ones((3, 2)))
    trace = read(file)
    assert trace["p"].shape == (3, 2)
    assert robustness("(G (norm(p) > 1)) & (F (x > 1))", trace) > 0
    np.savez(file, time=np.arange(2.0), x=np.ones((2, 2, 2)))
    with pytest.raises(ValueError, match=r"npz .*column 'x' must have .* got \[2, 2, 2\]"):
        read(file)
