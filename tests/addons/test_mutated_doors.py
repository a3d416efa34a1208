"""Mutated files of every door of the add-ons give a result, or one error in words."""

import io
import json
import logging
import struct
import warnings
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from mutated import ODD as ODD_VALUES
from mutated import altered, flipped, wrong_answers
from recorded_files import WRITERS

import verifai_jax as vj
from verifai_jax.addons.assurance.odd_files import read_odd
from verifai_jax.addons.assurance.traceability.evidence import claims_in
from verifai_jax.addons.assurance.traceability.tested import read_cases
from verifai_jax.addons.monitoring.recording import read
from verifai_jax.addons.reports.claims import sealed
from verifai_jax.addons.reports.stored import read_result
from verifai_jax.addons.rl.policies import policy
from verifai_jax.addons.simulators.fmu.description import read_description
from verifai_jax.cli.json_output import as_plain

FEW, MANY = 40, 500
POLICIES = Path(__file__).parent / "rl" / "policies" / "files"
JUNIT = """<testsuites><testsuite name="s"><testcase classname="a.b" name="t">
<properties><property name="vj_simulations" value="7"/></properties><failure message="no"/>
</testcase></testsuite></testsuites>"""
ODD = """TAXONOMY:
  scenery:
    road_type: [motorway, street, lane]
  dynamic:
    ego_speed: float velocity
ODD:
  town:
    INCLUDE_AND:
      road_type: [street, lane]
      ego_speed: "[0 .. 54] km/h"
    EXCLUDE_AND:
      road_type: lane
"""
BINDING = """openodd: [odd.yaml]
name: streets
features:
  speed: {attribute: dynamic.ego_speed, unit: m/s, reason: limit of the town, source: StVO 3}
  road: {attribute: road_type}
"""


def load(path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        loaded = policy(path, activation="elu" if path.suffix in (".pt", ".safetensors") else None)
        with np.load(POLICIES / f"{path.stem}.expected.npz") as known:
            jax.eval_shape(loaded.act, jnp.asarray(known["observations"][0]))


def columns():
    time = np.arange(30) * 0.1
    return {"time": time, "speed": np.sin(time), "gap": np.linspace(5.0, 1.0, 30)}


def write_hdf5(path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for name, values in columns().items():
            file.create_dataset(name, data=values, chunks=(10,), compression="gzip")


def write_netcdf(path):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("netCDF4")
    values = columns()
    time = values.pop("time")
    data = {name: ("time", column) for name, column in values.items()}
    xarray.Dataset(data, {"time": time}).to_netcdf(path)


def write_mcap(path):
    writer = pytest.importorskip("mcap.writer")
    with path.open("wb") as file:
        made = writer.Writer(file)
        made.start()
        schema = made.register_schema("any", "jsonschema", b"{}")
        channel = made.register_channel("/speed", "json", schema)
        for i in range(20):
            made.add_message(
                channel, i * 10**8, json.dumps({"v": i, "p": [1, 2]}).encode(), i * 10**8
            )
        made.finish()


def write_domain(path):
    path.write_text(BINDING)
    path.with_name("odd.yaml").write_text(ODD)


def write_estimate(path):
    found = vj.Estimate("it", 0.1, 0.05, 0.2, 0.95, "monte_carlo", 50, 90, 6, 0, 0.4, 50, 6, 0)
    about = {"command": "estimate", "version": "0.1.0"}
    path.write_text(json.dumps({**about, **as_plain(found)}))


MJCF = """<mujoco><option timestep="0.01"/><worldbody><body pos="0 0 1">
<joint name="swing" type="hinge" axis="0 1 0"/><geom type="capsule" size="0.05 0.3" mass="1"/>
</body></worldbody><actuator><motor joint="swing" gear="2"/></actuator></mujoco>"""
URDF = """<robot name="arm"><link name="base"/><link name="upper"><inertial><mass value="1.5"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="swing" type="continuous"><parent link="base"/><child link="upper"/>
<axis xyz="0 1 0"/></joint></robot>"""
SCENIC = """param limit = Range(3, 9)
ego = new Object at Range(-1, 1) @ 0, with speed Range(5, 10)
other = new Object at 3 @ Uniform(4, 5, 6)
require ego.position.x < 0.9
"""


def write_detector(path):
    made = vj.perception.detector(
        jax.random.key(0), (8, 8), kinds=1, values=1, channels=(4,), hidden=(4,)
    )
    vj.perception.save_detector(path, made)


def detect(path):
    network = vj.perception.load_detector(path)
    jax.eval_shape(network, jnp.zeros((*network.shape, 3)))


def load_model(path):
    pytest.importorskip("mujoco")
    vj.mujoco(path, duration=0.1, control_period=0.05)


def compile_scenes(path):
    pytest.importorskip("scenic")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        vj.scenic(path)


def write_claims(path):
    about = {"result": "run", "formulas": {"gap": "always gap > 0"}, "requirements": {},
             "model": "0" * 64, "backend": "jax"}  # fmt: skip
    files = [{"name": "log.csv", "sha256": "0" * 64}]
    claims = {"subject": "brake", "about": about, "inputs_sha256_chain": "", "files": files}
    path.write_text(json.dumps(sealed(claims)))


DOORS = {
    "ppo.zip": (None, load),
    "mlp.onnx": (None, load),
    "forest.onnx": (None, load),
    "quantised_dynamic.onnx": (None, load),
    "mlp.pt": (None, load),
    "mlp.safetensors": (None, load),
    "drive.csv": (lambda path: pd.DataFrame(columns()).to_csv(path, index=False), read),
    "drive.parquet": (lambda path: pd.DataFrame(columns()).to_parquet(path), read),
    "drive.npz": (lambda path: np.savez_compressed(path, **columns()), read),
    "drive.h5": (write_hdf5, read),
    "drive.nc": (write_netcdf, read),
    "drive.mcap": (write_mcap, read),
    **{name: (write, read) for name, write in WRITERS.items() if name != "drive.mf4"},
    "watch.fmu": (lambda path: vj.mtl.export_fmu("x > 0", 0.1, path), read_description),
    "streets.yaml": (write_domain, read_odd),
    "estimate.json": (write_estimate, lambda path: str(read_result(path))),
    "results.xml": (lambda path: path.write_text(JUNIT), lambda path: read_cases([path])),
    "report.claims.json": (write_claims, lambda path: list(claims_in([path]))),
    "detector.npz": (write_detector, detect),
}
"""Valid files: what writes one, or None where there is one already, and what reads it."""


SLOW_DOORS = {
    "model.xml": (lambda path: path.write_text(MJCF), load_model),
    "model.urdf": (lambda path: path.write_text(URDF), load_model),
    "scene.scenic": (lambda path: path.write_text(SCENIC), compile_scenes),
}
"""Doors of other packages' compilers, with fewer mutations."""


def rezipped(data, rng):
    """Return an archive with a member that is mutated, and its checksum right again."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = list(members)[rng.integers(len(members))]
    content = members[name]
    members[name] = (altered if content[:1] == b"{" else flipped)(content, rng)
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        for each, content in members.items():
            archive.writestr(each, content)
    return made.getvalue()


def check(name, tmp_path, count):
    write, read_it = (DOORS | SLOW_DOORS)[name]
    path = tmp_path / name
    if write is not None:
        write(path)
    content = path.read_bytes() if write is not None else (POLICIES / name).read_bytes()
    path.write_bytes(content)
    read_it(path)
    wrong = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        zipped = zipfile.is_zipfile(io.BytesIO(content)) and rng.integers(4)
        of_json = path.suffix == ".json" and rng.integers(4)
        path.write_bytes((rezipped if zipped else altered if of_json else flipped)(content, rng))
        if why := wrong_answers(lambda: read_it(path)):
            wrong.append(f"{seed}: {why}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.filterwarnings("ignore:.*is read as Windows-1252")
@pytest.mark.parametrize("name", DOORS)
def test_mutated(name, tmp_path, caplog):
    caplog.set_level(logging.CRITICAL, "verifai_jax")
    check(name, tmp_path, FEW)


def test_detectors_whose_numbers_do_not_fit_are_refused(tmp_path):
    path = tmp_path / "it.npz"
    write_detector(path)
    with np.load(path) as file:
        arrays = dict(file)
    about = json.loads(str(arrays["about"]))
    changes = [("about", {**about, key: odd}) for key in about for odd in ODD_VALUES]
    changes += [
        (name, odd)
        for name in arrays
        if name != "about"
        for odd in (np.zeros(3), np.zeros((2, 2)), "x")
    ]
    for name, value in changes:
        changed = {"about": np.array(json.dumps(value))} if name == "about" else {name: value}
        np.savez_compressed(path, **{**arrays, **changed})
        assert not wrong_answers(lambda: vj.perception.load_detector(path)), (name, value)


@pytest.mark.thorough
@pytest.mark.parametrize("name", SLOW_DOORS)
def test_mutated_models(name, tmp_path, caplog):
    caplog.set_level(logging.CRITICAL, "verifai_jax")
    check(name, tmp_path, 20)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*is read as Windows-1252")
@pytest.mark.parametrize("name", [*DOORS, *SLOW_DOORS])
def test_many_mutated(name, tmp_path, caplog):
    caplog.set_level(logging.CRITICAL, "verifai_jax")
    check(name, tmp_path, 200 if name in SLOW_DOORS else MANY)


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
def test_a_chunk_of_a_recording_that_declares_a_terabyte(compression, tmp_path):
    writer = pytest.importorskip("mcap.writer")
    path = tmp_path / "drive.mcap"
    kind = getattr(writer.CompressionType, compression)
    with path.open("wb") as file:
        made = writer.Writer(file, compression=kind)
        made.start()
        schema = made.register_schema("any", "jsonschema", b"{}")
        channel = made.register_channel("/speed", "json", schema)
        for i in range(20):
            made.add_message(channel, i * 10**8, b'{"v": 1}', i * 10**8)
        made.finish()
    data = path.read_bytes()
    # A record is its opcode, the length of its content, and the content: 6 is a chunk.
    at = len(b"\x89MCAP0\r\n")
    while data[at] != 6:
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
    huge = struct.pack("<Q", 10**12)
    for places in ((at + 1,), (at + 9 + 16,), (at + 1, at + 9 + 16)):
        changed = bytearray(data)
        for place in places:
            changed[place : place + 8] = huge
        path.write_bytes(changed)
        assert not wrong_answers(lambda: read(path))
