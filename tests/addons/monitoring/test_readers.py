"""Readers of other tools' recordings, on small files that the libraries of the formats write."""

import gzip
import json
import shutil
import struct
from importlib.metadata import EntryPoint

import numpy as np
import pandas as pd
import pytest
import recorded_files
from checked_types import unchecked
from click.testing import CliRunner
from mutated import flipped, wrong_answers
from recorded_files import columns, write_bag, write_mat, write_mdf, write_ulog

from verifai_jax.addons.monitoring import mdf, readers, ros_bags
from verifai_jax.addons.monitoring.containers import table_of
from verifai_jax.addons.monitoring.recorded import named_recordings
from verifai_jax.cli.main import main
from verifai_jax.core.display import extensions
from verifai_jax.mtl import judge, read, robustness


def verdict(formula, *recordings, **options):
    (row,) = judge(formula, list(recordings), **options).rows
    assert not row.error, row.error
    return row


@pytest.mark.parametrize("name", ["drive.bag", "drive"])
def test_a_bag_of_ros_by_its_log_and_by_its_headers(tmp_path, name):
    write_bag(tmp_path / name)
    path = tmp_path / name
    trace = read(path)
    assert set(trace.signals) >= {"imu.angular_velocity.x", "mode.data=AUTO", "mode.data=OFF"}
    np.testing.assert_array_equal(trace["imu.angular_velocity.x"], 0.5 * np.arange(20))
    np.testing.assert_allclose(trace.times, 0.1 * np.arange(20), atol=1e-6)
    # The headers are 0.02 s before the log, and messages without one keep the log's times.
    early = read(path, stamps="header")
    np.testing.assert_allclose(np.asarray(early.times)[:3], [0, 0.02, 0.1], atol=1e-6)
    assert any("/mode" in n or "topic mode" in n for n in early.notes)
    assert verdict('eventually mode.data == "OFF"', path).verdict == "holds"


@pytest.mark.parametrize("kind", ["BZ2", "LZ4"])
def test_compressed_chunks_of_a_bag(tmp_path, kind, monkeypatch):
    path = tmp_path / "drive.bag"
    write_bag(path, compression=kind)
    assert read(path).length == 20
    monkeypatch.setattr(ros_bags, "MAX_CHUNK", 100)
    with pytest.raises(ValueError, match=r"drive\.bag cannot be read: a chunk is cut, or unpacks"):
        read(path)


def test_a_bag_in_several_files_is_one_recording(tmp_path):
    bag = tmp_path / "run"
    bag.mkdir()
    for index in range(2):
        write_bag(tmp_path / f"part{index}", first=20 * index)
        shutil.copy(tmp_path / f"part{index}" / f"part{index}.db3", bag / f"run_{index}.db3")
        write_bag(tmp_path / f"one_2024-01-01-10-0{index}-00_{index}.bag", first=20 * index)
    assert [name for name, _ in named_recordings(bag)] == [str(bag)]
    assert read(bag).length == 40
    for part in ("part0", "part1"):
        shutil.rmtree(tmp_path / part)
    shutil.rmtree(bag)
    assert [name for name, _ in named_recordings(tmp_path)] == [str(tmp_path)]
    np.testing.assert_array_equal(read(tmp_path)["imu.angular_velocity.x"], 0.5 * np.arange(40))


def test_definitions_of_messages_are_no_code(tmp_path):
    """A name of a type gets into Python code that `rosbags` runs."""
    mark = tmp_path / "ran"
    write_bag(tmp_path / "bag")
    path = tmp_path / "bag" / "bag.db3"
    import sqlite3

    for name in (f"std_msgs/msg/X:\n    open({str(mark)!r}, 'w')\n#", "std_msgs/msg/X(print)"):
        base = sqlite3.connect(path)
        base.execute("UPDATE topics SET type=? WHERE name='/mode'", (name,))
        base.execute("UPDATE message_definitions SET topic_type=?, encoded_message_definition="
                     "'string data' WHERE topic_type LIKE '%String%' OR topic_type LIKE '%X%'",
                     (name,))  # fmt: skip
        base.commit()
        base.close()
        trace = read(path)
        assert any("is no name of a type" in note for note in trace.notes)
        assert not mark.exists()


def test_arrays_of_nothing_are_refused():
    from rosbags.interfaces import Nodetype
    from rosbags.typesys import get_types_from_msg

    separator = "=" * 80
    text = f"Nothing[] all\nuint8 x\n{separator}\nMSG: a/Nothing\nuint8 KIND=1\n"
    types = get_types_from_msg(text, "a/msg/Many")
    with pytest.raises(ValueError, match="an array all of messages without a field"):
        ros_bags._check_types(types, Nodetype)


def test_topics_of_ulog(tmp_path):
    path = tmp_path / "flight.ulg"
    write_ulog(path)
    trace = read(path)
    np.testing.assert_allclose(np.asarray(trace.times), 0.1 * np.arange(20) + 1)
    np.testing.assert_array_equal(trace["attitude.q"][:, 0], 0.5 * np.arange(20))
    np.testing.assert_array_equal(trace["attitude.armed"], np.arange(20) > 5)
    known = ~np.isnan(trace["battery_1.voltage"])
    np.testing.assert_allclose(trace["battery_1.voltage"][known], 12 - 0.1 * np.arange(1, 20, 2),
                               rtol=1e-6)  # fmt: skip


def test_a_message_of_ulog_that_declares_a_million_numbers(tmp_path):
    path = tmp_path / "flight.ulg"
    write_ulog(path)
    fields = b"float[60000] q;" * 17
    made = path.read_bytes().replace(
        struct.pack("<HB", 50, ord("F")) + b"attitude:uint64_t timestamp;float[2] q;bool armed;",
        struct.pack("<HB", 9 + len(fields), ord("F")) + b"attitude:" + fields,
    )
    assert len(made) != path.stat().st_size
    path.write_bytes(made)
    with pytest.raises(ValueError, match=r"flight\.ulg cannot be read: .*more than 10,000 numbers"):
        read(path)


@pytest.mark.slow
def test_channels_and_frames_of_mdf(tmp_path):
    path = tmp_path / "car.mf4"
    write_mdf(path)
    k = np.arange(40)
    plain = read(path)
    assert any("frames of a CAN bus" in note for note in plain.notes)
    np.testing.assert_allclose(plain["root"], 2 * k + np.sqrt(k))
    np.testing.assert_allclose(plain["p"], 0.5 * k + 1)
    np.testing.assert_array_equal(plain["mode=AUTO"], k % 3 == 1)
    assert plain.units == {"x": "m", "p": "kPa"}
    trace = read(path, dbc=tmp_path / "car.dbc")
    speed = np.where(k[::2] == 10, np.nan, k[::2] * 1.5)
    np.testing.assert_allclose(trace["Speed"][::2], speed)  # "not available" is a gap
    np.testing.assert_allclose(trace["Angle"][1::2], 2.0 * k[1::2] - 5, atol=1e-9)
    np.testing.assert_array_equal(trace["Motion.Gear=REVERSE"][::2], k[::2] // 2 % 3 == 2)
    row = verdict('always[1, 2] Motion.Gear != "DRIVE"', path, dbc=tmp_path / "car.dbc",
                  method="hold")  # fmt: skip
    assert (row.verdict, row.robustness) == ("fails", -1.0)
    (tmp_path / "car.dbc").write_text("no database")
    with pytest.raises(ValueError, match=r"car\.dbc is no DBC file"):
        read(path, dbc=tmp_path / "car.dbc")


@pytest.mark.slow
@pytest.mark.parametrize("formula", ["().__class__.__bases__[0]", "9**9**9**9*X1", "exit(X1)"])
def test_a_formula_of_mdf_is_not_evaluated(tmp_path, formula):
    path = tmp_path / "car.mf4"
    write_mdf(path, formula)
    trace = read(path)
    assert "root" not in trace.signals
    assert any("is not evaluated" in note for note in trace.notes)


@pytest.mark.slow
def test_mutated_mdf(tmp_path):
    """A crash of the package's C code is an error that names the file."""
    path = tmp_path / "car.mf4"
    write_mdf(path)
    content = path.read_bytes()
    for seed in range(30):
        path.write_bytes(flipped(content, np.random.default_rng(seed)))
        assert not wrong_answers(lambda: read(path, dbc=tmp_path / "car.dbc")), seed


def test_a_reader_of_mdf_that_dies_is_an_error(tmp_path, monkeypatch):
    path = tmp_path / "car.mf4"
    write_mdf(path)
    monkeypatch.setattr(mdf, "__name__", "nothing")
    with pytest.raises(ValueError, match=r"car\.mf4 is damaged, its reader died \(1\): .*nothing"):
        read(path)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ValueError, match=r"car\.mf4 is no file of MDF 4, or is cut"):
        read(path)


def test_variables_of_matlab(tmp_path):
    path = tmp_path / "flight.mat"
    write_mat(path)
    trace = read(path)
    at = np.isin(np.round(np.asarray(trace.times), 3), np.round(0.4 * np.arange(5), 3))
    fast = ~np.isnan(trace["speed"])
    np.testing.assert_allclose(trace["speed"][fast], np.sin(0.1 * np.arange(20)))
    np.testing.assert_array_equal(trace["mode=AUTO"][fast], np.arange(20) >= 5)
    np.testing.assert_allclose(trace["imu.gyro.x"][at], (0.4 * np.arange(5)) ** 2)
    np.testing.assert_allclose(trace["scope.height"][at], 0.8 * np.arange(5))
    assert trace["p"].shape[1] == 2


def test_matlab_of_version_7_3_is_hdf5(tmp_path):
    h5py, path = pytest.importorskip("h5py"), tmp_path / "flight.mat"
    time = np.arange(20) * 0.1
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in (("time", time[None]), ("p", np.stack([time, -time])),
                            ("armed", (time > 1).astype("u1")[None]),
                            ("title", np.array([[65], [66]], "u2"))):  # fmt: skip
            kind = {"armed": b"logical", "title": b"char"}.get(name, b"double")
            file.create_dataset(name, data=array).attrs["MATLAB_class"] = np.bytes_(kind)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(512))
    trace = read(path)
    assert set(trace.signals) == {"p", "armed"}
    assert trace["p"].shape == (20, 2)
    assert float(robustness("always p[0] >= p[1]", trace)) == 0.0


@pytest.mark.parametrize("name", ["drive.feather", "drive.jsonl", "drive.csv.gz", "drive.tsv"])
def test_tables(tmp_path, name):
    path = tmp_path / name
    if name == "drive.tsv":
        pd.DataFrame(columns()).to_csv(path, index=False, sep="\t")
    else:
        recorded_files.WRITERS[name](path)
    trace, prefix = read(path), "car." if name == "drive.jsonl" else ""
    np.testing.assert_allclose(trace[f"{prefix}speed"], np.sin(0.1 * np.arange(30)))
    np.testing.assert_array_equal(trace[f"{prefix}mode=AUTO"], columns()["mode"] == "AUTO")


def test_damaged_tables_are_read_up_to_the_damage(tmp_path):
    recorded_files.write_csv_gz(tmp_path / "a.csv.gz")
    whole = (tmp_path / "a.csv.gz").read_bytes()
    rows = "".join(f"{k},{k}\n" for k in range(20000))
    packed = gzip.compress(f"time,x\n{rows}".encode())
    (tmp_path / "cut.csv.gz").write_bytes(packed[: len(packed) // 2])
    trace = read(tmp_path / "cut.csv.gz")
    assert 1000 < trace.length < 20000
    assert any("was cut" in note for note in trace.notes)
    (tmp_path / "no.csv.gz").write_bytes(b"time,x\n0,1\n")
    with pytest.raises(ValueError, match=r"no\.csv\.gz is no gzip file"):
        read(tmp_path / "no.csv.gz")
    (tmp_path / "two.csv.gz").write_bytes(whole + gzip.compress(b"3.0,0,OFF\n"))
    assert read(tmp_path / "two.csv.gz").length == 31
    lines = [json.dumps({"time": k, "x": k}) for k in range(5)]
    (tmp_path / "cut.jsonl").write_text("\n".join(lines) + '\n{"time": 5, "x"')
    trace = read(tmp_path / "cut.jsonl", time_unit="s")
    assert trace.length == 5
    assert any("no JSON object" in note for note in trace.notes)


def test_words_sentinels_and_stamps_on_request(tmp_path):
    path = tmp_path / "drive.csv"
    path.write_text("time,mode,x,on\n0,OFF,1,ON\n1,AUTO,-9999,OFF\n3,AUTO,4,ON\n2,AUTO,3,ON\n"
                    "3,,5,ON\n4,OFF,6,OFF\n")  # fmt: skip
    options = {"time_unit": "s", "sort_times": True, "repeated": "last"}
    trace = read(path, missing=[-9999, "hold"], **options)
    np.testing.assert_array_equal(trace.times, [0, 1, 2, 3, 4])
    np.testing.assert_array_equal(trace["x"], [1, 1, 3, 5, 6])
    np.testing.assert_array_equal(read(path, missing={"x": -9999}, **options)["x"][:2], [1, np.nan])
    np.testing.assert_array_equal(trace["on"], [1, 0, 1, 1, 0])
    row = verdict('always (mode == "AUTO" -> x <= 4)', path, missing=[-9999, "hold"], **options)
    assert (row.verdict, row.robustness, row.instant) == ("fails", -1.0, 3.0)
    row = verdict('always mode != "FAULT"', path, missing=[-9999, "hold"], **options)
    assert (row.verdict, row.robustness) == ("holds", 1.0)
    assert "'mode' is never 'FAULT', but 'AUTO', 'OFF'" in row.note
    arguments = ["monitor", 'always mode != "AUTO"', str(path), "--missing", "-9999", "--missing",
                 "hold", "--sort-times", "--repeated", "last", "--time-unit", "s"]  # fmt: skip
    said = CliRunner().invoke(main, arguments)
    assert "fails with robustness -1" in said.output, said.output
    with unchecked(), pytest.raises(ValueError, match=r"unknown kind of stamps .logs."):
        read(path, stamps="logs")


def test_a_reader_of_another_package(tmp_path, monkeypatch):
    points = {readers.GROUP: {"lab": EntryPoint("lab", "test_readers:read_lab", readers.GROUP)}}
    monkeypatch.setattr(extensions, "_entry_points", lambda: points)
    (tmp_path / "a.lab").write_text("1 2 3")
    assert [name for name, _ in named_recordings(tmp_path)] == [str(tmp_path / "a.lab")]
    np.testing.assert_array_equal(read(tmp_path / "a.lab")["x"], [1, 2, 3])
    (tmp_path / "a.lab").write_text("one")
    with pytest.raises(ValueError, match=r"a\.lab cannot be read: ValueError: could not convert"):
        read(tmp_path / "a.lab")


def read_lab(path, asked):
    numbers = [float(word) for word in path.read_text().split()]
    return [table_of({asked.time: np.arange(len(numbers)) * 0.1, "x": numbers})]
