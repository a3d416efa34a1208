"""Programs compiled in the background, and the collector that waits meanwhile."""

import gc
import threading
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.core.compute import compilation
from verifai_jax.core.compute.compilation import (
    compile_soon,
    describe_compilation,
    tracing,
    while_compiling,
)
from verifai_jax.core.compute.keys import run_keys, simulation_key


class Slow:
    """A lowered program whose compilation lasts until it is let go."""

    def __init__(self):
        self.go, self.begun = threading.Event(), threading.Event()

    def compile(self, **options):
        self.begun.set()
        self.go.wait(10)
        return lambda x: x + 1


def test_a_program_is_compiled_beside_others_and_called_like_a_function():
    doubled = compile_soon("one", jax.jit(lambda x: 2 * x).lower(jnp.float32(0)))
    tripled = compile_soon("other", jax.jit(lambda x: 3 * x).lower(jnp.float32(0)))
    assert (doubled(jnp.float32(2)), tripled(jnp.float32(2))) == (4, 6)
    assert doubled.result() is doubled.result()


def test_what_is_compiled_is_said_while_it_is():
    slow = Slow()
    compiling = compile_soon("the search", slow)
    assert slow.begun.wait(10)
    assert describe_compilation() == "compiling the search, 0 s"
    slow.go.set()
    assert compiling(1) == 2
    assert describe_compilation() == ""


def test_work_is_done_once_while_this_process_waits_for_a_program():
    done = []
    while_compiling(lambda: done.append(1))
    quick = compile_soon("one", jax.jit(lambda x: x + 1).lower(jnp.float32(0)))
    quick._future.result()
    assert quick(jnp.float32(1)) == 2
    assert done == []  # There was nothing to wait for.
    slow = Slow()
    compiling = compile_soon("other", slow)
    while_compiling(slow.go.set)
    assert compiling(1) == 2
    assert done == [1]
    assert not compilation._meanwhile


def test_what_is_needed_later_is_done_in_long_waits_alone():
    done = []

    class Short(Slow):
        def compile(self, **options):
            time.sleep(0.05)
            return super().compile(**options)

    short = Short()
    short.go.set()
    needed, later = partial(done.append, "needed"), partial(done.append, "later")
    while_compiling(later)
    while_compiling(needed, after=0.0)
    while_compiling(needed, after=0.0)
    assert compile_soon("short", short)(1) == 2
    assert done == ["needed"]
    assert list(compilation._meanwhile) == [later]
    compilation._meanwhile.clear()


def test_less_effort_gives_the_same_numbers_and_unknown_options_are_left_out(monkeypatch):
    x = np.linspace(0, 1, 64, dtype=np.float32)
    efforts = {}
    for effort in ("most", "little", "least"):
        lowered = jax.jit(lambda x: jnp.sort(jnp.sin(x) * 3)).lower(x)
        efforts[effort] = np.asarray(compile_soon("one", lowered, effort)(x))
    np.testing.assert_array_equal(efforts["most"], efforts["little"])
    np.testing.assert_allclose(efforts["most"], efforts["least"], rtol=1e-6)
    monkeypatch.setattr(jax.config, "read", lambda name: False)
    monkeypatch.setitem(compilation._OPTIONS, "little", {"no_such_option": True})
    assert not compilation.known_options({"no_such_option": True})
    plain = jax.jit(lambda x: x * 3).lower(x)
    program = compile_soon("one", plain, "little", splits=False, wide=True)
    np.testing.assert_array_equal(program(x), 3 * x)


def test_what_the_compiler_raises_is_raised_where_the_program_is_called():
    class Broken:
        def compile(self):
            raise RuntimeError("no room")

    compiling = compile_soon("the search", Broken())
    with pytest.raises(RuntimeError, match="no room"):
        compiling(1)
    assert not compilation._running


def test_ctrl_c_gives_up_what_waits_and_what_waited_is_compiled_when_called(monkeypatch):
    monkeypatch.setattr(compilation, "available_cores", lambda: 1)
    compilation._pool.cache_clear()
    slow, waiting = Slow(), Slow()
    waiting.go.set()
    first, second = compile_soon("one", slow), compile_soon("other", waiting)
    assert slow.begun.wait(10)
    with monkeypatch.context() as patch:
        patch.setattr(first._future, "result", interrupted)
        with pytest.raises(KeyboardInterrupt):
            first.result()
    assert second._future.cancelled()
    assert not waiting.begun.is_set()
    assert second(1) == 2
    slow.go.set()
    assert first(1) == 2
    compilation._pool.cache_clear()


def interrupted():
    raise KeyboardInterrupt


def test_what_is_traced_is_said_as_well():
    with tracing("the search"):
        assert describe_compilation() == "compiling the search, 0 s"
        with tracing("gradients"), tracing():
            assert describe_compilation() == "compiling gradients, 0 s"
        assert describe_compilation() == "compiling the search, 0 s"
    assert describe_compilation() == ""


def test_the_collector_waits_while_programs_are_traced():
    assert gc.isenabled()
    with tracing():
        with tracing():
            assert not gc.isenabled()
        assert not gc.isenabled()
    assert gc.isenabled()


@pytest.mark.parametrize("seed", [0, 1, 12345, 2**31 - 1, 2**32 - 1])
def test_the_keys_of_a_seed_are_those_of_jax(seed):
    with jax.threefry_partitionable(True):
        expected = jax.random.split(jax.random.key(seed, impl="threefry2x32"))
    found = [np.asarray(jax.random.key_data(key)) for key in run_keys(seed)]
    np.testing.assert_array_equal(found, np.asarray(jax.random.key_data(expected)))
    key = run_keys(seed)[1]
    for row in (0, 1, 77_777, 2**32 - 1):
        one, other = simulation_key(key, row), jax.random.fold_in(key, row)
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(jax.random.key_data(one), jax.random.key_data(other))
