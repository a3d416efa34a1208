"""A cache of native libraries that was damaged, killed or shared, and compilers that misbehave."""

import os
import shutil
import stat
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.addons.native.native_code import machine_code
from verifai_jax.addons.native.native_code.library import approve, is_approved, library_name, load
from verifai_jax.addons.native.native_code.machine_code import Unavailable
from verifai_jax.addons.native.native_code.source import translate

pytestmark = pytest.mark.thorough

FORMS = (
    jax.ShapeDtypeStruct((2,), jnp.float32), jax.ShapeDtypeStruct((2,), jnp.uint32),
    jax.ShapeDtypeStruct((), jnp.int32), jax.ShapeDtypeStruct((), jnp.float32),
    jax.ShapeDtypeStruct((1,), jnp.float32),
)  # fmt: skip
SLEEPING = 'sleep 60 & echo $! > "$0.sleeper"; wait'


@pytest.fixture
def folder(monkeypatch, tmp_path):
    monkeypatch.setenv("VERIFAI_JAX_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "native"


def source():
    return translate(jax.make_jaxpr(lambda row, *_: (2 * row).view(jnp.uint32))(*FORMS))


def never():
    raise AssertionError("it is compiled again")


def doubles(made):
    rows = np.array([[1, 2], [3, 4]], np.float32)
    zeros = np.zeros(2, np.float32)
    out = made(rows, np.zeros(2, np.uint32), 0, zeros, zeros[:1], 1)
    return np.array_equal(out.view(np.float32), 2 * rows)


def made(translated=source):
    return load(library_name("doubled"), 2, translated)


def compiler_of(folder, script):
    folder.mkdir(exist_ok=True)
    tool = folder / "c++"
    tool.write_text(f"#!/bin/sh\n{script}\n")
    tool.chmod(0o755)
    return tool


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"", b"yes", b"no"])
def test_a_damaged_record_is_no_record(folder, content):
    path = made().path
    approve(path, True)
    assert is_approved(path) is True
    path.with_suffix(".agrees").write_bytes(content)
    assert is_approved(path) is None
    approve(path, False)
    assert is_approved(path) is False


def test_the_record_of_another_library_is_none(folder):
    path = made().path
    approve(path, True)
    other = path.with_name(f"{path.stem[:-4]}0000.so")
    shutil.copy(path.with_suffix(".agrees"), other.with_suffix(".agrees"))
    assert is_approved(other) is None


@pytest.mark.parametrize("size", [0, 100, 5000, -200])
def test_a_truncated_library_is_made_anew(folder, size):
    path = made().path
    content = path.read_bytes()[:size]
    path.unlink()
    path.write_bytes(content)
    assert doubles(made())
    assert [each.suffix for each in folder.iterdir()] == [".so"]
    assert doubles(made(never))


def test_a_library_without_its_functions_is_made_anew(folder, tmp_path):
    path = made().path
    path.unlink()
    (tmp_path / "one.c").write_text("int other() { return 1; }")
    subprocess.run(
        ["c++", "-shared", "-fPIC", tmp_path / "one.c", "-o", tmp_path / "one.so"], check=True
    )
    content = (tmp_path / "one.so").read_bytes()
    foreign = path.with_name(f"{library_name('doubled')}-{machine_code._checksum(content)}.so")
    foreign.write_bytes(content)
    assert doubles(made())
    assert not foreign.exists()


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ('while [ "$1" != -o ]; do shift; done; echo rubbish > "$2"', "cannot be loaded"),
        ('@real "$@"; while [ "$1" != -o ]; do shift; done; truncate -s 9000 "$2"',
         "cannot be loaded"),
        ('echo "int f() { return 1; }" > f.cpp; while [ "$1" != -o ]; do shift; done; '
         '@real -shared -fPIC f.cpp -o "$2"', "cannot be loaded: .*width"),
        ("kill -9 $$", "failed"),
        (SLEEPING, "took more than 1 s"),
    ],
)  # fmt: skip
def test_what_a_compiler_makes_is_tried_by_another_process(
    folder, monkeypatch, tmp_path, script, words
):
    tool = compiler_of(tmp_path / "bin", script.replace("@real", shutil.which("c++")))
    monkeypatch.setenv("PATH", f"{tool.parent}:{os.environ['PATH']}")
    monkeypatch.setattr(machine_code, "MAX_SECONDS", 1.0 if script == SLEEPING else 30.0)
    began = time.monotonic()
    with pytest.raises(Unavailable, match=words):
        made()
    assert not list(folder.iterdir())
    if script == SLEEPING:
        assert time.monotonic() - began < 10
        # What the compiler has started ends with it.
        sleeper = int(tool.with_name("c++.sleeper").read_text())
        for _ in range(50):
            status = Path(f"/proc/{sleeper}/stat")
            if not status.exists() or " Z " in status.read_text():
                break
            time.sleep(0.1)
        else:
            pytest.fail("it sleeps on")


def test_a_link_to_a_program_of_many_names_is_called_by_its_name(folder, monkeypatch, tmp_path):
    real = compiler_of(
        tmp_path, f'case "$0" in *c++) exec {shutil.which("c++")} "$@";; esac; exit 7'
    )
    real.rename(tmp_path / "ccache")
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "c++").symlink_to(tmp_path / "ccache")
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    assert doubles(made())


def test_a_relative_folder(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("VERIFAI_JAX_CACHE", "here")
    assert doubles(made())
    assert list((tmp_path / "here" / "native").glob("*.so"))


def test_what_a_killed_process_left_is_removed(folder):
    code = "import os; print(os.getpid())"
    gone = int(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout)
    folder.mkdir(parents=True, mode=0o700)
    dead, alive, elsewhere = (
        folder / f"tmp-{process}-{host}-abc"
        for process, host in (
            (gone, machine_code._HOST), (os.getpid(), machine_code._HOST), (gone, "00000000"))
    )  # fmt: skip
    old = folder / "tmpolder"
    for each in (dead, alive, elsewhere, old):
        each.mkdir()
        (each / "program.cpp").write_text("")
    os.utime(old, (0, 0))
    made()
    assert {each.name for each in folder.glob("tmp*")} == {alive.name, elsewhere.name}


RACE = """
import sys
sys.path.insert(0, sys.argv[1])
import test_native_cache as t
assert t.doubles(t.made())
"""


@pytest.mark.slow
def test_processes_that_compile_the_same_do_not_disturb_each_other(folder):
    command = [sys.executable, "-c", RACE, os.path.dirname(__file__)]
    racers = [subprocess.Popen(command) for _ in range(3)]
    assert [racer.wait(120) for racer in racers] == [0, 0, 0]
    assert doubles(made(never))
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert not list(folder.glob("tmp*"))


def test_the_name_depends_on_the_compiler(monkeypatch, tmp_path):
    monkeypatch.setenv("VERIFAI_JAX_CACHE", str(tmp_path))
    first = library_name("doubled")
    tool = compiler_of(tmp_path / "bin", "exit 1")
    monkeypatch.setenv("PATH", f"{tool.parent}:{os.environ['PATH']}")
    assert library_name("doubled") != first
