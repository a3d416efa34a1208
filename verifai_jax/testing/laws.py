"""Comparisons of the contract suites; their errors name the broken law."""

import jax
import numpy as np
from jaxtyping import PyTree


def same_type(before: PyTree, after: PyTree, step: str = "tell") -> None:
    assert jax.tree.structure(before) == jax.tree.structure(after), (
        f"{step} must keep the state's form"
    )
    pairs = zip(jax.tree.leaves_with_path(before), jax.tree.leaves(after), strict=True)
    for (path, one), two in pairs:
        # A weak type, of what was made from Python's numbers only, is no difference to a run.
        assert (one.shape, one.dtype) == (two.shape, two.dtype), (
            f"{step} must keep the types of the state; its part "
            f"{jax.tree_util.keystr(path) or 'state'} was {one.dtype}{list(one.shape)} and became "
            f"{two.dtype}{list(two.shape)}"
        )


def same(one: PyTree, two: PyTree, law: str, exact: bool = False) -> None:
    assert jax.tree.structure(one) == jax.tree.structure(two), f"{law}; the forms differ"
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        a, b = np.asarray(a), np.asarray(b)
        assert a.dtype == b.dtype, f"{law}; dtypes are {a.dtype} and {b.dtype}"
        # Rounding happens at the scale of the domain, which its values show.
        scale = 0.0 if exact else 1e-6 * float(np.max(np.abs(a), initial=0.0))
        close = np.array_equal(a, b) if a.dtype.kind not in "f" else np.allclose(a, b, 0, scale)
        assert close, f"{law}; got {a} and {b}"
