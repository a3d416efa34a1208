"""Monitors as FMUs: they say what `watch` says, wherever they are simulated."""

import shutil
import subprocess
import sys
import zipfile

import numpy as np
import pytest
from click.testing import CliRunner

import verifai_jax as vj
from verifai_jax.addons.monitoring import fmu_monitor
from verifai_jax.addons.native.native_code.machine_code import Unavailable
from verifai_jax.cli.main import main

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or shutil.which("c++") is None, reason="a binary of Linux is compiled"
)
DT = 0.1
FORMULAS = {
    "response": "always (x > 0 -> eventually[0, 0.5] norm(p) < 1)",
    "past": "historically[0, 0.3] x > -1",
}


def test_it_says_what_watch_says(tmp_path):
    file = vj.mtl.export_fmu(FORMULAS, DT, tmp_path / "both.fmu", sizes={"p": 2})
    table = vj.fmu_variables(file)
    assert [*table.index[:3]] == ["x", "p[0]", "p[1]"]
    assert [*table.index[3:6]] == ["response", "response_low", "response_high"]
    rng = np.random.default_rng(0)
    samples = {name: rng.normal(size=30) for name in table.index[:3]}

    def play(time, outputs, features):
        return {name: values[round(time / DT)] for name, values in samples.items()}

    system = vj.fmu(file, duration=3.0, dt=DT, controller=play, workers=None)
    for _ in range(2):  # An instance that is reset begins anew.
        trace = system({})
        watch = vj.mtl.watch(FORMULAS, DT, sizes={"p": 2})
        for k in range(30):
            p = np.array([samples["p[0]"][k], samples["p[1]"][k]])
            said = watch.step({"x": samples["x"][k], "p": p})
            low, high = watch.interval()
            for name in FORMULAS:
                found = [trace.signals[f"{name}{kind}"][k + 1] for kind in ("", "_low", "_high")]
                np.testing.assert_array_equal(found, [said[name], low[name], high[name]])


@pytest.mark.parametrize("command", [["gcc", "-std=c99", "-pedantic"], ["g++", "-x", "c++"]])
def test_its_source_compiles_without_a_warning(command, tmp_path):
    if shutil.which(command[0]) is None:
        pytest.skip(f"there is no {command[0]}")
    file = vj.mtl.export_fmu("always true", DT, tmp_path / "true.fmu")
    with zipfile.ZipFile(file) as archive:
        archive.extract("sources/monitor.c", tmp_path)
    flags = ["-Wall", "-Wextra", "-Werror", "-c", "-o", "/dev/null"]
    subprocess.run([*command, *flags, tmp_path / "sources/monitor.c"], check=True, timeout=60)


def test_the_command_line_writes_one(tmp_path):
    file = tmp_path / "gap.fmu"
    done = CliRunner().invoke(
        main, ["monitor", "always gap > 2", "--dt", "0.1", "--export-c", str(file)]
    )
    assert done.exit_code == 0, done.output
    system = vj.fmu(file, duration=0.5, dt=0.25, workers=None)
    with pytest.raises(RuntimeError, match=r"step of communication must be a multiple of 0\.1 s"):
        system({"gap": 3.0})
    held = vj.fmu(file, duration=0.4, dt=0.2, workers=None)({"gap": 3.0})
    assert held.signals["robustness"][-1] == 1.0


def test_without_a_compiler_it_has_the_source_alone(tmp_path, monkeypatch):
    def missing(*_):
        raise Unavailable("none")

    monkeypatch.setattr(fmu_monitor, "compile_library", missing)
    file = vj.mtl.export_fmu("x > 0", DT, tmp_path / "x.fmu")
    assert zipfile.ZipFile(file).namelist() == ["modelDescription.xml", "sources/monitor.c"]


def test_refusals(tmp_path):
    with pytest.raises(ValueError, match=r"the name of an FMU ends in \.fmu; got gap\.h"):
        vj.mtl.export_fmu("x > 0", DT, tmp_path / "gap.h")
    with pytest.raises(ValueError, match="would have one name with another: x; name the formulas"):
        vj.mtl.export_fmu({"x": "x > 0"}, DT, tmp_path / "x.fmu")
