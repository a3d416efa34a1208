"""Writers of small recordings by the libraries of their formats, for tests of their readers."""

import gzip
import json
import struct

import numpy as np
import pandas as pd
import pytest

START = 1_700_000_000
"""Seconds since 1970."""
DBC = """VERSION ""
BU_: ECU
BO_ 291 Motion: 8 ECU
 SG_ Speed : 0|16@1+ (0.01,0) [0|655.35] "km/h" ECU
 SG_ Accel : 16|12@1- (0.1,0) [-100|100] "m/s2" ECU
 SG_ Gear : 28|4@1+ (1,0) [0|15] "" ECU
BO_ 2147484192 Body: 8 ECU
 SG_ Angle : 7|16@0- (0.1,-5) [0|0] "deg" ECU
 SG_ Gear : 24|4@1+ (1,0) [0|15] "" ECU
VAL_ 291 Gear 0 "PARK" 1 "DRIVE" 2 "REVERSE" ;
VAL_ 291 Speed 65535 "SNA" ;
"""


def columns(count=30):
    time = np.arange(count) * 0.1
    mode = np.array(["OFF", "AUTO", "MANUAL"])[np.arange(count) // 4 % 3]
    return {"time": time, "speed": np.sin(time), "mode": mode}


def _imu(store, seconds, value):
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=int(seconds), nanosec=round(seconds % 1 * 1e9))
    more = {"seq": 0} if "seq" in types["std_msgs/msg/Header"].__dataclass_fields__ else {}
    vector = types["geometry_msgs/msg/Vector3"]
    return types["sensor_msgs/msg/Imu"](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="imu", **more),
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.zeros(9), angular_velocity=vector(x=value, y=0.0, z=0.0),
        angular_velocity_covariance=np.zeros(9), linear_acceleration=vector(x=0.0, y=0.0, z=9.8),
        linear_acceleration_covariance=np.zeros(9),
    )  # fmt: skip


def write_bag(path, first=0, count=20, delay=0.02, compression=None):
    """Write a bag of ROS 1 (`.bag`) or 2 (a folder) of IMU messages that are logged late."""
    rosbags = pytest.importorskip("rosbags")
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    assert rosbags
    one = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_HUMBLE)
    writer = rosbag1.Writer(path) if one else rosbag2.Writer(path, version=9)
    if compression:
        writer.set_compression(getattr(rosbag1.Writer.CompressionFormat, compression))
    with writer:
        imu = writer.add_connection("/imu", "sensor_msgs/msg/Imu", typestore=store)
        mode = writer.add_connection("/mode", "std_msgs/msg/String", typestore=store)
        pack = store.serialize_ros1 if one else store.serialize_cdr
        for k in range(first, first + count):
            at = START + 0.1 * k
            logged = START * 10**9 + round((0.1 * k + delay) * 1e9)
            writer.write(imu, logged, pack(_imu(store, at, 0.5 * k), "sensor_msgs/msg/Imu"))
            word = store.types["std_msgs/msg/String"](data="AUTO" if k % 4 else "OFF")
            writer.write(mode, logged, pack(word, "std_msgs/msg/String"))


def write_db3(path):
    folder = path.with_name("bag")
    write_bag(folder)
    path.write_bytes((folder / "bag.db3").read_bytes())


def write_ulog(path):
    """Write a log of PX4 after the description of its format."""
    pytest.importorskip("pyulog")

    def record(kind, content):
        return struct.pack("<HB", len(content), ord(kind)) + content

    data = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), record("B", bytes(40))]
    data += [record("F", b"attitude:uint64_t timestamp;float[2] q;bool armed;")]
    data += [record("F", b"battery:uint64_t timestamp;float voltage;")]
    for number, (instance, name) in enumerate([(0, b"attitude"), (0, b"battery"), (1, b"battery")]):
        data.append(record("A", struct.pack("<BH", instance, number) + name))
    for k in range(20):
        own = struct.pack("<HQ2f?", 0, 10**6 + k * 10**5, 0.5 * k, -k, k > 5)
        data.append(record("D", own))
        data.append(record("D", struct.pack("<HQf", 1 + k % 2, 10**6 + k * 10**5, 12 - 0.1 * k)))
    path.write_bytes(b"".join(data))


def write_mdf(path, formula="X1*2+sqrt(X1)", unreadable=False):
    """Write an MDF with numbers, words, a formula, and CAN frames that cantools has encoded."""
    asammdf, cantools = pytest.importorskip("asammdf"), pytest.importorskip("cantools")
    from asammdf.blocks.source_utils import Source

    path.with_name("car.dbc").write_text(DBC)
    base, count = cantools.database.load_string(DBC), 40
    time, ids = np.arange(count) * 0.1, np.where(np.arange(count) % 2, 544, 291)
    kinds = [("BusChannel", "u1"), ("ID", "<u4"), ("IDE", "u1"), ("DLC", "u1"),
             ("DataLength", "u1"), ("DataBytes", "(8,)u1")]  # fmt: skip
    frames = np.zeros(count, [(f"CAN_DataFrame.{name}", kind) for name, kind in kinds])
    frames["CAN_DataFrame.ID"], frames["CAN_DataFrame.IDE"] = ids, ids == 544
    frames["CAN_DataFrame.BusChannel"] = 1
    frames["CAN_DataFrame.DLC"] = frames["CAN_DataFrame.DataLength"] = 8
    for k in range(count):
        body = {"Angle": k * 2.0 - 5, "Gear": k % 4}
        speed = "SNA" if k == 10 else k * 1.5
        motion = {"Speed": speed, "Accel": -k * 0.5, "Gear": k // 2 % 3}
        name, values = ("Body", body) if ids[k] == 544 else ("Motion", motion)
        coded = base.get_message_by_name(name).encode(values)
        frames["CAN_DataFrame.DataBytes"][k] = np.frombuffer(coded, np.uint8)
    made = asammdf.MDF(version="4.10")
    bus = Source("CAN1", "CAN1", "", Source.SOURCE_BUS, Source.BUS_TYPE_CAN)
    made.append(asammdf.Signal(frames, time, name="CAN_DataFrame", source=bus))
    texts = {"val_0": 0, "val_1": 1, "val_2": 2, "default_addr": b"?"}
    texts |= {"text_0": b"OFF", "text_1": b"AUTO", "text_2": b"MANUAL"}
    counted = np.arange(count)
    made.append([
        asammdf.Signal(np.sin(time), time, name="x", unit="m"),
        asammdf.Signal((counted % 3).astype("u1"), time, name="mode", conversion=texts),
        asammdf.Signal(counted.astype("u2"), time, name="root", conversion={"formula": formula}),
        asammdf.Signal(counted.astype("u2"), time, name="p", unit="kPa",
                       conversion={"a": 0.5, "b": 1.0}),
    ])  # fmt: skip
    made.save(path, overwrite=True)
    made.close()


def write_mat(path):
    from scipy.io import savemat

    time = np.arange(20) * 0.1
    slow = np.arange(5) * 0.4
    signals = np.array([({"values": 2 * slow[:, None], "label": "height"},)], dtype=object)
    savemat(path, {
        "time": time[:, None], "speed": np.sin(time)[None], "armed": (time > 1)[:, None],
        "p": np.stack([time, -time], 1), "title": "a flight",
        "mode": np.array([["OFF" if k < 5 else "AUTO" for k in range(20)]], object),
        "imu": {"time": slow, "gyro": {"x": slow**2}},
        "scope": {"time": slow, "signals": signals[0, 0]},
    }, do_compression=True)  # fmt: skip


def write_feather(path):
    pd.DataFrame(columns()).to_feather(path, compression="zstd")


def write_jsonl(path):
    rows = pd.DataFrame(columns()).to_dict("records")
    lines = [json.dumps({"time": r["time"], "car": {"speed": r["speed"], "mode": r["mode"]}})
             for r in rows]  # fmt: skip
    path.write_text("\n".join(lines) + "\n")


def write_csv_gz(path):
    with gzip.open(path, "wt") as file:
        pd.DataFrame(columns()).to_csv(file, index=False)


WRITERS = {
    "drive.bag": write_bag, "drive.db3": write_db3, "drive.ulg": write_ulog,
    "drive.mf4": write_mdf, "drive.mat": write_mat, "drive.feather": write_feather,
    "drive.jsonl": write_jsonl, "drive.csv.gz": write_csv_gz,
}  # fmt: skip
"""A file of each format, and what writes it."""
