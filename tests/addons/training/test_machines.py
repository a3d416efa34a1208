"""Choices by the machine: devices, chunks, lanes, form of the monitor; the benchmark of GPUs."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import verifai_jax as vj
from verifai_jax.addons.rl import batched_training
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.evaluation.engine import Engine
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.evaluation.layout import chunks_and_lanes
from verifai_jax.mtl import _robustness as lane_chunks
from verifai_jax.mtl import parallel, sequential, windows

ROOT = Path(__file__).parents[3]


def line(features, key):
    noise = jax.random.normal(key, (16,)) * 0.01
    return vj.Trace({"x": features["a"] + noise}, dt=0.1)


LINE = vj.Problem("line", {"a": vj.Box(0, 1), "b": vj.Box(0, 1)}, line, "always[0, 0.5] x < 0.9")


@settings(max_examples=200, deadline=None)
@given(st.integers(1, 100_000), st.integers(1, 64))
def test_a_batch_fits_its_lanes_chunks_and_devices_and_wastes_few(batch, devices):
    chunks, lanes = chunks_and_lanes(LINE, batch, devices)
    used = min(devices, batch)
    assert 1 <= lanes <= LINE.system.lanes
    assert chunks * lanes * used >= batch
    # At most a row in each chunk, and a device's share, is padding.
    assert chunks * lanes * used < batch + used * (chunks + 1)


@pytest.mark.parametrize("text", ["G (x > 0)", "F[0,3] (x > 0)", "(x > 0) U[1,5] (y > 0)"])
def test_an_accelerator_gets_the_parallel_monitor_with_the_same_values(text, monkeypatch):
    rng = np.random.default_rng(0)
    signals = {name: rng.standard_normal(23).astype(np.float32) for name in ("x", "y")}
    formula = vj.parse(text)
    used = {name: signals[name] for name in formula.signals()}
    here = float(vj.robustness(formula, vj.Trace(used, dt=1.0)))
    assert windows._form() is sequential
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert windows._form() is parallel
    assert float(vj.robustness(formula, vj.Trace(used, dt=1.0))) == here


def test_an_accelerator_takes_all_lanes_of_the_monitor_at_once(monkeypatch):
    sizes = []

    def seen(x):
        sizes.append(x.shape[0])
        return (x,)

    whole = np.zeros((4 * lane_chunks.LANES, 2), np.float32)
    in_chunks = lane_chunks.in_chunks
    jax.eval_shape(lambda x: in_chunks(seen, (0,), (0,), x), whole)
    assert max(sizes) < len(whole)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    sizes.clear()
    jax.eval_shape(lambda x: in_chunks(seen, (0,), (0,), x), whole)
    assert sizes == [len(whole)]


def test_an_accelerator_trains_many_at_a_time():
    accelerator = Mock(spec=jax.Device, platform="gpu")
    training = batched_training.BatchedTraining([], devices=[accelerator])
    assert training.per_device == batched_training.RUNS_PER_ACCELERATOR
    assert batched_training.BatchedTraining([]).per_device == 1


CODE = """
import json, sys, zlib
sys.path[:0] = ["tests/addons/training", "tests/addons/training/sweeps"]
import jax, numpy as np
import verifai_jax as vj
from test_machines import LINE
from drifting import drifting

found = {"devices": len(jax.local_devices())}
for batch in (100, 2048):
    table = vj.falsify(LINE, "uniform", 3000, batch=batch).table.all
    found[f"table {batch}"] = zlib.crc32(table["rho"].to_numpy().tobytes())
few = vj.Certification(samples=64, attack_simulations=64)
swept = vj.sweep(drifting(seeds=2), configurations=2, certification=few)
for name in ("failure_rate", "nominal_return", "worst_robustness"):
    values = np.asarray(swept.record.columns[name], np.float64)
    found[name] = zlib.crc32(values.tobytes())
print(json.dumps(found))
"""


@pytest.mark.slow
def test_simulated_devices_give_the_same_tables_and_the_same_sweep():
    found = []
    for devices in (1, 3):
        environment = {
            **os.environ,
            "XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}",
            "PYTHONPATH": str(ROOT),
        }
        done = subprocess.run(
            [sys.executable, "-c", CODE], capture_output=True, text=True, cwd=ROOT, env=environment
        )
        assert done.returncode == 0, done.stderr[-2000:]
        found.append(json.loads(done.stdout.splitlines()[-1]))
        assert found[-1].pop("devices") == devices
    assert found[0] == found[1]


@pytest.mark.thorough
def test_a_block_of_a_worker_has_the_lanes_of_one_machine_whatever_its_devices():
    u = np.random.default_rng(0).random((700, 2)).astype(np.float32)
    whole = Evaluator(LINE, 700)(u, first=0).rho
    _, lanes = chunks_and_lanes(LINE, 700, len(jax.local_devices()))
    for count in (1, len(jax.local_devices())):
        devices = jax.local_devices()[:count]
        engine = Engine(LINE, lanes * count, devices=devices, lanes=lanes)
        assert (engine.layout.lanes, engine.layout.chunks) == (lanes, 1)
        key = Evaluator(LINE, 700).key
        first = engine.evaluate(u[: lanes * count], key, 0).rho
        np.testing.assert_array_equal(first, whole[: lanes * count])


def gpu_benchmark():
    spec = importlib.util.spec_from_file_location("gpu_benchmark", ROOT / "benchmarks" / "gpu.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_section_on_accelerators_is_written_once_where_it_belongs():
    gpu = gpu_benchmark()
    about = {"version": "1", "jax": "2", "devices": 4, "device": "Some GPU"}
    entry = {"what": "a", "unit": "rows/s", "speed": 10.0, "compiling": 2.0}
    other = {"a": {**entry, "speed": 40.0}, "mjx": {"what": "mjx", "error": "ValueError: no"}}
    text = gpu.section([(about, {"a": entry}), (about, other)])
    assert "| a | rows/s | 10 (2 s) | 40 (2 s) | 4 |" in text
    assert "| mjx |  | not measured | ValueError: no |  |" in text
    results = f"# Measured\n\n## First\n\n1\n\n{gpu.BEFORE}\n\n2\n"
    once = gpu.written(results, text)
    assert once.index("## First") < once.index(gpu.HEADING) < once.index(gpu.BEFORE)
    assert gpu.written(once, text) == once
    assert gpu.BEFORE in (ROOT / "benchmarks" / "RESULTS.md").read_text()


def test_an_accelerator_multiplies_matrices_in_whole_precision(monkeypatch):
    def product(a):
        return a @ a

    with in_precision("float32"):
        assert "HIGHEST" not in str(jax.make_jaxpr(product)(np.eye(2)))
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with in_precision("float32"):
        assert "HIGHEST" in str(jax.make_jaxpr(product)(np.eye(2)))
