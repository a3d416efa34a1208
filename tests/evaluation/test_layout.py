"""The layout of a batch: which programs get longer chunks and the processor's widest vectors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.evaluation.layout import Layout

LAYOUT = Layout(jax.local_devices()[:1], chunks=16, lanes=512)


def loop(step):
    """Return the program of a row that takes a step ten times."""
    return jax.make_jaxpr(lambda u: jax.lax.fori_loop(0, 10, lambda _, x: step(x), u))(
        jnp.zeros(3)
    ).jaxpr


@pytest.mark.parametrize(
    ("step", "lanes", "wide"),
    [
        (lambda x: jnp.where(x > 0, x * x, -x), 1024, True),
        (lambda x: x * jnp.all(jnp.isfinite(x[0])), 1024, True),
        (lambda x: jnp.tanh(x), 1024, False),
        (lambda x: x + jnp.sum(x), 512, True),
        (lambda x: np.ones((3, 3), np.float32) @ x, 512, True),
        (lambda x: x + jnp.arctan(x).sum(), 512, False),
    ],
)
def test_elementary_programs_have_longer_chunks_and_plain_ones_wide_vectors(step, lanes, wide):
    layout = LAYOUT.for_program(loop(step))
    assert (layout.lanes, layout.wide) == (lanes, wide)
    assert layout.padded == LAYOUT.padded


def test_an_odd_number_of_chunks_stays():
    layout = LAYOUT._replace(chunks=3).for_program(loop(jnp.abs))
    assert (layout.chunks, layout.lanes) == (3, 512)


def test_accelerators_keep_their_chunks(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert LAYOUT.for_program(loop(jnp.abs)) is LAYOUT
