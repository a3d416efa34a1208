"""Recordings with damage: the rest is read, and what is not is named, with the name of the file."""

import bisect
import itertools
import re

import h5py
import numpy as np
import pytest

from verifai_jax.addons.monitoring.stamps import in_order
from verifai_jax.mtl import read, robustness

ROWS = [f"{k / 10},{k},{2 * k}" for k in range(20)]


def table(tmp_path, rows, encoding="utf-8", end="\n", head="time,x,y"):
    path = tmp_path / "drive.csv"
    path.write_bytes("\n".join([head, *rows]).encode(encoding) + end.encode(encoding))
    return path


def test_rows_with_other_numbers_of_cells_and_blocks_of_zeros_are_left_out(tmp_path):
    for odd in ("1.05,1", "1.05,1,2,3", "\0" * 64):
        trace = read(table(tmp_path, [*ROWS[:10], odd, *ROWS[10:]]))
        assert trace["x"].tolist() == list(range(20))
        (note,) = (note for note in trace.notes if "left out" in note)
        assert note.startswith(f"1 row such as {odd[:20]!r}"[:30])
        assert "where there are 3 names" in note


@pytest.mark.parametrize(
    "encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "cp1252"]
)
def test_every_encoding_is_read_and_a_cut_character_is_of_the_last_line(tmp_path, encoding):
    path = table(tmp_path, ROWS, encoding, head="time,größe,y")
    trace = read(path)
    assert trace["größe"].tolist() == list(range(20))
    assert any("Windows-1252" in note for note in trace.notes) == (encoding == "cp1252")
    if encoding.startswith("utf-16"):
        path.write_bytes(path.read_bytes()[:-1])
        assert len(read(path)["y"]) >= 19


def test_a_text_that_ends_within_a_character_is_still_utf8(tmp_path):
    path = table(tmp_path, ROWS, head="time,größe,y")
    path.write_bytes(path.read_bytes() + "2.0,ö".encode()[:-1])
    trace = read(path)
    assert trace["größe"].tolist() == list(range(20))
    assert any("the last line" in note and "was cut" in note for note in trace.notes)


def test_rows_without_a_time_or_with_one_that_goes_back_are_left_out(tmp_path):
    for odd in (",7,7", "bad,7,7", "inf,7,7", "0.25,7,7", "1e12,7,7", "-5,7,7"):
        trace = read(table(tmp_path, [*ROWS[:10], odd, *ROWS[10:]]))
        assert trace["x"].tolist() == list(range(20)), odd
        note = "1 row (row 11): left out: their times are missing, or go back"
        assert trace.notes[note] == 1
    back = [*ROWS[:10], *ROWS[3:8], *ROWS[10:]]
    with pytest.raises(ValueError, match=r"drive\.csv: sample times must increase; row 10 has 0.9"):
        read(table(tmp_path, back))
    dates = [f"2024-01-01T00:00:{k:02d},{k},1" for k in range(20)]
    assert len(read(table(tmp_path, [*dates, "no date,1,1", *dates[-1:]]))["x"]) == 21


def test_the_rows_that_stay_are_the_most_that_never_go_back():
    rng = np.random.default_rng(3)
    for _ in range(200):
        times = np.sort(rng.integers(0, 40, 24)).astype(float)
        times[rng.choice(24, 2, replace=False)] = rng.choice([-1.0, 5.0, 50.0, np.nan, np.inf], 2)
        kept = in_order(times, {})
        most = next(
            count
            for count in range(24, 0, -1)
            for rows in itertools.combinations(range(24), count)
            if np.all(np.isfinite(times[[*rows]])) and np.all(np.diff(times[[*rows]]) >= 0)
        )
        assert len(kept) == most
        assert np.all(np.diff(times[kept]) >= 0)
        assert bisect.bisect(kept, 23) == len(kept)


def test_arrays_that_are_no_signals_are_left_out_by_name(tmp_path):
    path = tmp_path / "drive.npz"
    odd = {"three": np.ones((2, 2, 2)), "short": np.ones(3), "object": np.array([None] * 5)}
    np.savez(
        path, time=np.arange(5) / 10, x=np.arange(5, dtype=">f4"), c=np.ones(5, complex), **odd
    )
    trace = read(path)
    assert list(trace.signals) == ["x"]
    for name in (*odd, "c"):
        assert any(f"column {name!r}" in note and "left out" in note for note in trace.notes)


def test_data_sets_of_every_byte_order_and_groups_without_times(tmp_path):
    path = tmp_path / "drive.h5"
    with h5py.File(path, "w") as file:
        file["imu/time"] = np.arange(5, dtype=">f8") / 10
        file["imu/gyro"] = np.arange(5, dtype=">f4")
        file["imu/count"] = np.arange(5, dtype=">i2")
        file["imu/long"] = np.ones(5, np.longdouble)
        file["imu/image"] = np.ones((5, 4, 4))
        file["other/alone"] = np.ones(7)
        file["gps/time"] = np.array([0.0, 0.2])
        file["gps/speed"] = np.ones(2)
    trace = read(path, missing="hold")
    assert {*trace.signals} == {"imu.gyro", "imu.count", "imu.long", "gps.speed"}
    assert trace["imu.gyro"].tolist() == [0, 1, 2, 3, 4]
    assert "column 'other.alone' has no sample times: it is left out" in trace.notes
    assert any("column 'imu.image' must have shape" in note for note in trace.notes)
    assert robustness("always imu.count >= 0", trace) == 0


@pytest.mark.parametrize("name", ["a.csv", "a.parquet", "a.npz", "a.nc", "a.h5", "a.mcap"])
@pytest.mark.parametrize("data", [b"", b"hello", bytes(range(256)) * 9, b"PK\x03\x04" + 40 * b"x"])
def test_damage_is_told_with_the_name_of_the_file(tmp_path, name, data):
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(ValueError, match=re.escape(name)):
        read(path)
