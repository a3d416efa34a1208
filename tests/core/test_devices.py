"""The number of JAX devices and the compile cache, each in a process of its own."""

import os
import subprocess
import sys

import pytest


def run(code, **environment):
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
        check=False,
    )


@pytest.mark.thorough
def test_one_device_per_core():
    done = run(
        "import verifai_jax, jax, os; print(len(jax.devices()), len(os.sched_getaffinity(0)))"
    )
    devices, cores = done.stdout.split()
    assert devices == cores


@pytest.mark.thorough
@pytest.mark.parametrize(("cores", "devices"), [("1", "1"), ("3", "3")])
def test_the_user_may_choose(cores, devices):
    done = run("import verifai_jax, jax; print(len(jax.devices()))", VERIFAI_JAX_CORES=cores)
    assert done.stdout.strip() == devices


def test_a_choice_that_is_none():
    done = run("import verifai_jax", VERIFAI_JAX_CORES="many")
    assert "VERIFAI_JAX_CORES must be a positive integer; got 'many'" in done.stderr


@pytest.mark.thorough
def test_a_backend_that_runs_already_is_left_alone():
    done = run("import jax; jax.devices(); import verifai_jax; print(len(jax.devices()))")
    assert done.stdout.strip() == "1"


@pytest.mark.slow
def test_a_full_disk_keeps_no_halves_of_programs(tmp_path):
    code = (
        "import shutil, types, jax\n"
        "shutil.disk_usage = lambda _: types.SimpleNamespace(free=1000)\n"
        "from verifai_jax.core.compute.devices import enable_compile_cache\n"
        "enable_compile_cache()\n"
        "print(jax.config.jax_compilation_cache_dir)\n"
    )
    assert run(code, VERIFAI_JAX_CACHE=str(tmp_path)).stdout.strip() == "None"
    code = code.replace("1000", "2**40")
    assert run(code, VERIFAI_JAX_CACHE=str(tmp_path)).stdout.strip() == str(tmp_path)


@pytest.mark.slow
def test_compiled_programs_outlive_the_process(tmp_path):
    code = (
        "import jax.numpy as jnp, verifai_jax as vj\n"
        "system = lambda f, key: vj.Trace({'x': jnp.sin(f['a'] * jnp.arange(50.))}, dt=1.0)\n"
        "p = vj.Problem('p', space={'a': vj.Box(0, 1)}, system=system, spec='always x < 2')\n"
        "vj.falsify(p, 'uniform', 10, batch=10)\n"
    )
    from verifai_jax.core.compute import devices

    done = run(
        "import verifai_jax.core.compute.devices as d, jax\n"
        "d.enable_compile_cache()\n"
        "jax.config.update('jax_persistent_cache_min_compile_time_secs', 0.0)\n" + code,
        VERIFAI_JAX_CACHE=str(tmp_path),
    )
    assert done.returncode == 0, done.stderr
    assert list(tmp_path.iterdir())
    done = run(code, VERIFAI_JAX_CACHE="off", XDG_CACHE_HOME=str(tmp_path / "home"))
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "home").exists()
    assert devices.cache_folder() is None  # as tests/conftest.py sets it
