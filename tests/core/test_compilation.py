"""Programs compiled in the background, and the collector that waits meanwhile."""

import gc
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.core import compilation
from verifai_jax.core.compilation import compile_soon, describe_compilation, tracing
from verifai_jax.core.keys import run_keys


class Slow:
    """A lowered program whose compilation lasts until it is let go."""

    def __init__(self):
        self.go, self.begun = threading.Event(), threading.Event()

    def compile(self):
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


def test_what_the_compiler_raises_is_raised_where_the_program_is_called():
    class Broken:
        def compile(self):
            raise RuntimeError("no room")

    compiling = compile_soon("the search", Broken())
    with pytest.raises(RuntimeError, match="no room"):
        compiling(1)
    assert not compilation._running


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
