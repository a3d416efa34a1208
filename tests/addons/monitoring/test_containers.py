"""Recordings of several clocks: MCAP, NetCDF, Zarr, HDF5, LeRobot's episodes, several files.

Where a package is missing, a double of the few names that are used of it stands in for it.
"""

import array
import contextlib
import importlib.util
import json
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest
from checked_types import unchecked
from pyarrow import parquet

from verifai_jax.addons.monitoring.recorded import named_traces
from verifai_jax.core.messages.errors import MissingExtra, UnknownNameError
from verifai_jax.mtl import judge, read, robustness

START = 1_700_000_000_000_000_000
"""Nanoseconds since 1970."""


@pytest.fixture
def double(monkeypatch):
    """Let modules of a package consist of some names, whether it is installed or not."""

    def install(**modules):
        for name, names in modules.items():
            module = ModuleType(name.replace("__", "."))
            vars(module).update(names)
            monkeypatch.setitem(sys.modules, module.__name__, module)

    return install


def message(channel, milliseconds, data):
    return None, channel, SimpleNamespace(log_time=START + milliseconds * 10**6, data=data)


class Vector(SimpleNamespace):
    __slots__ = ("covariance", "label", "x", "y")


def test_topics_of_mcap_have_clocks_of_their_own(tmp_path, double):
    class McapError(Exception):
        pass

    odometry = SimpleNamespace(id=1, topic="/odom", message_encoding="json")
    imu = SimpleNamespace(id=2, topic="/imu/data", message_encoding="cdr")
    other = SimpleNamespace(id=3, topic="/cloud", message_encoding="ros1")
    sent = [
        message(odometry, 0, json.dumps({"twist": {"x": 1}, "frame": "a", "p": [1, 2]}).encode()),
        message(imu, 50, (3.0, 4.0)),
        message(odometry, 100, json.dumps({"twist": {"x": 2.5}, "p": [3, 4]}).encode()),
        message(imu, 150, (5.0, 6.0)),
        message(other, 160, b""),
    ]

    class Factory:
        def decoder_for(self, encoding, schema):
            assert encoding == "cdr"
            return decode

    def decode(data):
        sent = Vector()
        sent.x, sent.y = data
        sent.covariance, sent.label = array.array("d", [1, 2, 3]), "imu"
        return sent

    double(
        mcap={},
        mcap__reader={"make_reader": lambda file: SimpleNamespace(iter_messages=lambda: sent)},
        mcap__exceptions={"McapError": McapError},
        mcap_ros2={},
        mcap_ros2__decoder={"DecoderFactory": Factory},
    )
    path = tmp_path / "drive.mcap"
    path.write_bytes(b"")
    trace = read(path)
    assert list(trace.signals) == [
        "odom.twist.x", "odom.p", "imu.data.covariance", "imu.data.label=imu", "imu.data.x",
        "imu.data.y",
    ]  # fmt: skip
    np.testing.assert_allclose(trace.times, [0, 0.05, 0.1, 0.15])
    np.testing.assert_array_equal(trace["odom.twist.x"], [1, np.nan, 2.5, np.nan])
    np.testing.assert_array_equal(trace["imu.data.covariance"][1], [1, 2, 3])
    assert trace["odom.p"].shape == (4, 2)
    even = read(path, resample_to=0.05, method="hold")
    assert float(robustness("always[0.05, 0.15] imu.data.x >= odom.twist.x", even)) == 0.5


@pytest.mark.skipif(importlib.util.find_spec("mcap") is None, reason="needs mcap")
def test_a_file_of_mcap_by_its_own_writer(tmp_path):
    from mcap.writer import Writer

    path = tmp_path / "drive.mcap"
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("Speed", "jsonschema", b"{}")
        channel = writer.register_channel("/speed", "json", schema)
        for k, value in enumerate([1.0, 3.0, 2.0]):
            stamp = START + k * 10**8
            data = json.dumps({"value": value}).encode()
            writer.add_message(channel, stamp, data, stamp)
        writer.finish()
    assert float(robustness("always speed.value < 4", read(path))) == 1.0


class Variable(SimpleNamespace):
    @property
    def ndim(self):
        return self.values.ndim

    @property
    def size(self):
        return self.values.size


def dataset(**variables):
    coordinates = {k: v for k, v in variables.items() if k == v.dims[0]}
    return SimpleNamespace(
        variables=coordinates,
        data_vars={k: v for k, v in variables.items() if k not in coordinates},
    )


@pytest.mark.parametrize("name", ["flight.nc", "flight.zarr"])
def test_variables_of_a_dimension_share_its_coordinate(tmp_path, double, name):
    days = np.array(["2024-01-01T00:00:00", "2024-01-01T00:00:01"], "datetime64[ns]")
    found = dataset(
        time=Variable(dims=("time",), values=days, attrs={}),
        height=Variable(dims=("time",), values=np.array([100.0, 90.0]), attrs={"units": "m"}),
        p=Variable(dims=("time", "axis"), values=np.ones((2, 3)), attrs={}),
        slow=Variable(dims=("slow_time",), values=np.array([1.0]), attrs={}),
        slow_time=Variable(dims=("slow_time",), values=days[:1], attrs={}),
    )
    opened = contextlib.nullcontext(found)
    double(xarray={"open_dataset": lambda path, **_: opened, "open_zarr": lambda path, **_: opened})
    path = tmp_path / name
    path.mkdir() if name.endswith("zarr") else path.write_bytes(b"")
    trace = read(path)
    assert trace.units == {"height": "m"}
    np.testing.assert_array_equal(trace.times, [0.0, 1.0])
    np.testing.assert_array_equal(trace["slow"], [1.0, np.nan])
    assert trace["p"].shape == (2, 3)
    assert list(named_traces(tmp_path)) == [str(path)]


def test_data_sets_of_hdf5_have_the_times_of_their_group(tmp_path, double):
    class Set(SimpleNamespace):
        ndim = property(lambda self: self.values.ndim)
        dtype = property(lambda self: self.values.dtype)
        shape = property(lambda self: self.values.shape)
        size = property(lambda self: self.values.size)

        def __getitem__(self, key):
            return self.values

    def data(values, **attributes):
        return Set(values=np.array(values), attrs=attributes)

    items = {
        "time": data([0.0, 1.0, 2.0]),
        "speed": data([1.0, 2.0, 3.0], units=b"m/s"),
        "imu": SimpleNamespace(),
        "imu/time": data([0.5, 1.5]),
        "imu/raw/gyro": data([[1, 2], [3, 4]], units="rad/s"),
        "name": data(b"text"),
    }

    class File(contextlib.nullcontext):
        def __init__(self, path, mode):
            super().__init__(self)

        def visititems(self, visit):
            for name, item in items.items():
                visit(name, item)

    double(h5py={"File": File})
    path = tmp_path / "log.h5"
    path.write_bytes(b"")
    trace = read(path, missing="hold")
    np.testing.assert_array_equal(trace.times, [0, 0.5, 1, 1.5, 2])
    np.testing.assert_array_equal(trace["speed"], [1, 1, 2, 2, 3])
    np.testing.assert_array_equal(trace["imu.raw.gyro"][1:, 0], [1, 1, 3, 3])
    assert trace.units == {"speed": "m/s", "imu.raw.gyro": "rad/s"}


@pytest.mark.parametrize(
    ("name", "package"), [("a.mcap", "mcap"), ("a.nc", "xarray"), ("a.h5", "h5py")]
)
def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch, name, package):
    monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(MissingExtra, match=rf"{package} .*pip install 'verifai_jax\[recordings\]'"):
        read(tmp_path / name)


@pytest.fixture
def lerobot(tmp_path):
    """Make a data set of three episodes in two files, as LeRobot writes them."""
    folder = tmp_path / "pick"
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text('{"codebase_version": "v3.0", "fps": 30}')
    parquet.write_table(pa.table({"task": ["pick"]}), folder / "meta" / "tasks.parquet")
    data = folder / "data" / "chunk-000"
    data.mkdir(parents=True)
    for file, episodes in (("file-000", [0, 1]), ("file-001", [2])):
        rows = [(episode, frame) for episode in episodes for frame in range(10)]
        columns = {
            "observation.state": [[float(episode), frame / 10] for episode, frame in rows],
            "action": [[0.0, 1.0] for _ in rows],
            "timestamp": pa.array([frame / 30 for _, frame in rows], pa.float32()),
            "frame_index": [frame for _, frame in rows],
            "episode_index": [episode for episode, _ in rows],
        }
        parquet.write_table(pa.table(columns), data / f"{file}.parquet")
    return folder


def test_episodes_of_lerobot_are_recordings(lerobot):
    trace = read(lerobot, episode=1)
    assert trace["observation.state"].shape == (10, 2)
    np.testing.assert_array_equal(trace["observation.state"][:, 0], 1.0)
    found = judge("always[0, 0.1] observation.state[0] < 1.5", lerobot)
    verdicts = [(row.file.removeprefix(str(lerobot.parent)), row.verdict) for row in found.rows]
    assert verdicts == [
        ("/pick episode 0", "holds"), ("/pick episode 1", "holds"), ("/pick episode 2", "fails"),
    ]  # fmt: skip
    file = lerobot / "data" / "chunk-000" / "file-000.parquet"
    with pytest.raises(ValueError, match="has episodes 0 to 1: name one, as in episode=0"):
        read(file)
    with pytest.raises(ValueError, match="it has no episode 7, episode=0 to 2"):
        read(lerobot, episode=7)
    with pytest.raises(ValueError, match="name one of its episodes"):
        read(lerobot)


def test_several_files_are_one_trace_on_one_calendar(tmp_path):
    (tmp_path / "imu.csv").write_text(
        "time,gyro\n2024-05-01T12:00:00+00:00,1\n2024-05-01T12:00:01+00:00,2\n"
    )
    (tmp_path / "gps.csv").write_text(f"time,speed\n{1714564800500},7\n{1714564801500},9\n")
    trace = read([tmp_path / "imu.csv", tmp_path / "gps.csv"])
    np.testing.assert_array_equal(trace.times, [0, 0.5, 1, 1.5])
    np.testing.assert_array_equal(trace["speed"], [np.nan, 7, np.nan, 9])
    np.testing.assert_array_equal(trace["gyro"], [1, np.nan, 2, np.nan])
    (tmp_path / "again.csv").write_text("time,gyro\n0,1\n")
    with pytest.raises(ValueError, match="the files has more than one column 'gyro'"):
        read([tmp_path / "imu.csv", tmp_path / "again.csv"])
    with pytest.raises(ValueError, match="has 2 clocks, so one period dt is not enough"):
        read([tmp_path / "imu.csv", tmp_path / "gps.csv"], dt=0.1)


def test_several_clocks_in_one_table(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t1,a,t2,b,c\n0,1,0.5,5,true\n1,2,1.5,6,false\n2,3,,,\n")
    trace = read(path, time={"t1": ["a"], "t2": ["b", "c"]})
    np.testing.assert_array_equal(trace.times, [0, 0.5, 1, 1.5, 2])
    np.testing.assert_array_equal(trace["b"], [np.nan, 5, np.nan, 6, np.nan])
    np.testing.assert_array_equal(trace["c"], [np.nan, 1, np.nan, 0, np.nan])
    with pytest.raises(UnknownNameError, match="has no column 'd'"):
        read(path, time={"t1": ["d"]})


def test_gaps_are_held_filled_or_left_out_by_name(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("time,a,b,c\n0,1,0,5\n1,,2,\n2,3,,7\n4,5,6,9\n")
    held = read(path, missing="hold")
    np.testing.assert_array_equal(held["a"], [1, 1, 3, 5])
    np.testing.assert_array_equal(held["b"], [0, 2, 2, 6])
    assert "signal 'a' has no value in 1 of 4 rows: its last one is held there" in held.notes
    mixed = read(path, missing={"a": "interpolate", "b": "drop"})
    np.testing.assert_array_equal(mixed.times, [0, 1, 4])
    np.testing.assert_array_equal(mixed["a"], [1, 2, 5])
    np.testing.assert_array_equal(mixed["c"], [5, np.nan, 9])
    even = read(path, dt=1.0, missing={"c": "drop"})
    np.testing.assert_array_equal(even.times, [0, 2, 3])
    with pytest.raises(UnknownNameError, match="unknown signal 'd'"):
        read(path, missing={"d": "hold"})
    with unchecked(), pytest.raises(UnknownNameError, match="unknown way to treat a gap 'fill'"):
        read(path, missing="fill")
