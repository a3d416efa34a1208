"""Batches of matrix factorizations on a processor that cannot deadlock.

Jaxlib 0.10.0 up to 0.11.1 divides a large batch of matrices into parts, and the calling thread
waits until other threads of XLA's pool have computed them. The calling thread may belong to the
pool itself: if all threads of the pool wait in this way, none is left for the parts, and the
program hangs. One Cholesky factorization or one linear solve of 20 rows in the dynamics of a batch
is enough. Later versions (jax-ml/jax, commit 859992407d) and earlier ones do not divide batches.

`avoid_deadlock` lowers these batches as a loop over blocks that are too small to be divided. The
same routine of LAPACK factorizes each matrix, so results do not change.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlib.version
from jax.interpreters import mlir

_BEGINS, _ENDS = (0, 10, 0), (0, 11, 2)
"""Versions of jaxlib that cut batches, the second one no more."""
_UNCUT = 200_000
"""Operations of a batch up to which jaxlib does not cut it."""


class _Factorization(NamedTuple):
    """What jaxlib takes for the work of a factorization, or a little more.

    - `ranks`: the ranks of the operands of one problem.
    - `work`: number of operations, from the shapes of these operands.
    """

    ranks: tuple[int, ...]
    work: Callable[..., float]


def _of_matrix(weight: float) -> _Factorization:
    return _Factorization((2,), lambda a: weight * a[0] * a[1] * min(a))


_FACTORIZATIONS = {
    "cholesky": _of_matrix(1 / 3), "lu": _of_matrix(1), "geqrf": _of_matrix(2),
    "svd": _of_matrix(10), "eigh": _of_matrix(5), "eig": _of_matrix(10), "schur": _of_matrix(5),
    "hessenberg": _of_matrix(2), "tridiagonal": _of_matrix(4 / 3),
    "geqp3": _Factorization((2, 1), lambda a, _: 2 * a[0] * a[1] * min(a)),
    "householder_product": _Factorization((2, 1), lambda a, taus: 4 * a[0] * a[1] * taus[0]),
    "ormqr": _Factorization((2, 1, 2), lambda a, taus, c: 4 * taus[0] * c[0] * c[1]),
    "triangular_solve": _Factorization((2, 2), lambda a, b: a[0] * b[0] * b[1]),
    "tridiagonal_solve": _Factorization((1, 1, 1, 2), lambda _, d, __, b: 5 * b[0] * b[1]),
}  # fmt: skip
"""Primitives of JAX whose batches jaxlib cuts, by their names."""


def avoid_deadlock() -> None:
    """Make this process lower large batches of factorizations in blocks, for affected versions.

    It applies to all programs of the process, whose results do not change.
    """
    if not _BEGINS <= jaxlib.version.__version_info__[:3] < _ENDS:
        return
    rules = mlir._platform_specific_lowerings["cpu"]
    for primitive, entry in list(rules.items()):
        known = _FACTORIZATIONS.get(primitive.name)
        if known is not None and getattr(entry.rule, "func", None) is not _lower:
            rule = partial(_lower, primitive, known, entry.rule)
            mlir.register_lowering(primitive, rule, platform="cpu")


def _lower(
    primitive: Any, known: _Factorization, original: Callable[..., Any], context: Any,
    *operands: Any, **parameters: Any,
) -> Any:  # fmt: skip
    """Lower a factorization as JAX does, or as a loop over blocks of its batch."""
    forms = context.avals_in
    if all(isinstance(size, int) for form in forms for size in form.shape):
        batch, block = forms[0].shape[: forms[0].ndim - known.ranks[0]], _block(known, forms)
        if math.prod(batch) > block:
            call = partial(primitive.bind, **parameters)
            blocks = partial(_in_blocks, call, known.ranks, batch, block)
            lower = mlir.lower_fun(blocks, multiple_results=primitive.multiple_results)
            return lower(context, *operands)
    return original(context, *operands, **parameters)


def _block(known: _Factorization, forms: Any) -> int:
    """Return how many problems of these forms jaxlib takes at once without cutting them."""
    shapes = (form.shape[form.ndim - rank :] for form, rank in zip(forms, known.ranks, strict=True))
    work = known.work(*shapes)
    if any(jnp.issubdtype(form.dtype, jnp.complexfloating) for form in forms):
        work *= 3
    return max(1, int(_UNCUT / max(work, 1)))


def _in_blocks(
    call: Callable[..., Any], ranks: tuple[int, ...], batch: tuple[int, ...], block: int,
    *operands: Any,
) -> Any:  # fmt: skip
    """Call a primitive on one block of the batch after the other."""
    count = math.prod(batch)
    whole = -(-count // block) * block

    def cut(operand: Any, rank: int) -> Any:
        matrices = operand.reshape(count, *operand.shape[operand.ndim - rank :])
        # The last matrix again, where the last block is not full.
        again = jnp.broadcast_to(matrices[-1:], (whole - count, *matrices.shape[1:]))
        return jnp.concatenate([matrices, again]).reshape(-1, block, *matrices.shape[1:])

    blocks = [cut(operand, rank) for operand, rank in zip(operands, ranks, strict=True)]
    results = jax.lax.map(lambda parts: call(*parts), tuple(blocks))

    def join(result: Any) -> Any:
        matrices = result.reshape(whole, *result.shape[2:])[:count]
        return matrices.reshape(*batch, *matrices.shape[1:])

    return jax.tree.map(join, results)
