"""A program of every primitive that JAX has: it equals XLA's, or is refused by name."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jax.experimental import io_callback
from jax.extend.random import threefry_2x32
from jax.scipy import special

from verifai_jax.addons.native.native_code import elementary, translation
from verifai_jax.addons.native.native_code.library import library_name, load
from verifai_jax.addons.native.native_code.source import translate
from verifai_jax.addons.native.native_code.values import Untranslatable
from verifai_jax.core.compute.jaxprs import CALLS, CUSTOM_CALLS, programs_in

pytestmark = pytest.mark.thorough

NAMES = """
import jax, jax.numpy, jax.extend.core.primitives as known
from jax.interpreters import ad
from jax._src.interpreters import mlir
names = {each.name for name, each in vars(known).items() if name.endswith("_p")}
names |= {each.name for each in [*ad.primitive_jvps, *mlir._lowerings]}
names |= {p.name for t in mlir._platform_specific_lowerings.values() for p in t}
print(*sorted(names))
"""


def near(x):
    """Numbers between -1 and 1."""
    return jnp.tanh(x)


def whole(x):
    return jnp.round(3 * near(x)).astype(jnp.int32)


def square(x):
    """A symmetric positive definite matrix."""
    m = jnp.outer(near(x), near(x))
    return m + 3 * jnp.eye(4)


def image(x):
    return jnp.outer(x, x).reshape(1, 1, 4, 4)


def key(x):
    return jax.random.key(whole(x)[0])


@jax.custom_jvp
def own(x):
    return 2 * x


own.defjvp(lambda primals, tangents: (own(*primals), 2 * tangents[0]))


@jax.custom_vjp
def other(x):
    return 2 * x


other.defvjp(lambda x: (other(x), None), lambda _, cotangent: (2 * cotangent,))


@jax.custom_batching.custom_vmap
def lanes(x):
    return 2 * x


lanes.def_vmap(lambda size, batched, x: (2 * x, True))


def windowed(operation, start):
    return lambda x: lax.reduce_window(
        image(x), start, operation, (1, 1, 2, 2), (1, 1, 1, 1), "VALID"
    )


def scattered(function):
    numbers = lax.ScatterDimensionNumbers((), (0,), (0,))
    return lambda x: function(x, jnp.array([[1], [3]]), x[:2], numbers)


ONE_OPERAND = {
    "abs": lax.abs,
    "asinh": lax.asinh,
    "atan": lax.atan,
    "cbrt": lax.cbrt,
    "ceil": lax.ceil,
    "cos": lax.cos,
    "cosh": lambda x: lax.cosh(near(x)),
    "erf": lax.erf,
    "erfc": lax.erfc,
    "exp": lambda x: lax.exp(near(x)),
    "exp2": lambda x: lax.exp2(near(x)),
    "floor": lax.floor,
    "expm1": lambda x: lax.expm1(near(x)),
    "is_finite": lax.is_finite,
    "logistic": lax.logistic,
    "neg": lax.neg,
    "round": lax.round,
    "sign": lax.sign,
    "sin": lax.sin,
    "square": lax.square,
    "sinh": lambda x: lax.sinh(near(x)),
    "tan": lambda x: lax.tan(near(x)),
    "tanh": lax.tanh,
    "acos": lambda x: lax.acos(0.9 * near(x)),
    "asin": lambda x: lax.asin(0.9 * near(x)),
    "acosh": lambda x: lax.acosh(2 + near(x)),
    "atanh": lambda x: lax.atanh(0.9 * near(x)),
    "erf_inv": lambda x: lax.erf_inv(0.9 * near(x)),
    "log": lambda x: lax.log(2 + near(x)),
    "log1p": lambda x: lax.log1p(0.9 * near(x)),
    "rsqrt": lambda x: lax.rsqrt(2 + near(x)),
    "sqrt": lambda x: lax.sqrt(2 + near(x)),
    "integer_pow": lambda x: lax.integer_pow(x, 3),
    "bessel_i0e": lax.bessel_i0e,
    "bessel_i1e": lax.bessel_i1e,
    "digamma": lax.digamma,
    "lgamma": lax.lgamma,
    "clz": lambda x: lax.clz(whole(x)),
    "not": lambda x: lax.bitwise_not(whole(x)),
    "population_count": lambda x: lax.population_count(whole(x)),
    "reduce_precision": lambda x: lax.reduce_precision(x, 5, 7),
    "convert_element_type": lambda x: (x > 0).astype(jnp.float32),
    "bitcast_convert_type": lambda x: lax.bitcast_convert_type(x, jnp.int32),
    "real": lambda x: lax.real(lax.complex(x, x)),
    "imag": lambda x: lax.imag(lax.complex(x, x)),
    "complex": lambda x: lax.real(lax.complex(x, x)),
    "stop_gradient": lax.stop_gradient,
    "conj": lambda x: lax.real(lax.conj(lax.complex(x, x))),
    "copy": lax.copy_p.bind,
    "optimization_barrier": lax.optimization_barrier,
}
TWO_OPERANDS = {
    "add": lax.add,
    "sub": lax.sub,
    "mul": lax.mul,
    "div": lambda x, y: x / (2 + near(y)),
    "max": lax.max,
    "min": lax.min,
    "atan2": lax.atan2,
    "rem": lambda x, y: lax.rem(x, 2 + near(y)),
    "pow": lambda x, y: lax.pow(2 + near(x), near(y)),
    "nextafter": lax.nextafter,
    "eq": lax.eq,
    "ne": lax.ne,
    "lt": lax.lt,
    "le": lax.le,
    "gt": lax.gt,
    "ge": lax.ge,
    "and": lambda x, y: whole(x) & whole(y),
    "or": lambda x, y: whole(x) | whole(y),
    "xor": lambda x, y: whole(x) ^ whole(y),
    "shift_left": lambda x, y: whole(x) << 2,
    "shift_right_arithmetic": lambda x, y: whole(x) >> 1,
    "shift_right_logical": lambda x, y: lax.shift_right_logical(whole(x), 1),
    "clamp": lambda x, y: lax.clamp(-0.5, x, 0.5),
    "select_n": lambda x, y: jnp.where(x < y, x, y),
    "eq_to": lambda x, y: lax.eq_to_p.bind(x, y),
    "le_to": lambda x, y: lax.le_to_p.bind(x, y),
    "lt_to": lambda x, y: lax.lt_to_p.bind(x, y),
    "igamma": lambda x, y: lax.igamma(jnp.exp(x), jnp.exp(y)),
    "igammac": lambda x, y: lax.igammac(jnp.exp(x), jnp.exp(y)),
    "igamma_grad_a": lambda x, y: lax.igamma_grad_a(jnp.exp(x), jnp.exp(y)),
    "random_gamma": lambda x, y: jax.random.gamma(key(x), 2 + near(y)),
    "regularized_incomplete_beta": lambda x, y: lax.betainc(jnp.exp(x), jnp.exp(y), 0.5 + 0 * x),
    "polygamma": lambda x, y: special.polygamma(1, jnp.exp(x)),
    "zeta": lambda x, y: lax.zeta(2 + jnp.exp(x), jnp.exp(y)),
    "add_any": lambda x, y: jax.vjp(lambda v: (v * y, v + 1), x)[1]((x, y))[0],
    "mulhi": lambda x, y: lax.mulhi(whole(x), whole(y)),
}
ARRAYS = {
    "argmax": lambda x: lax.argmax(x, 0, jnp.int32),
    "argmin": lambda x: lax.argmin(x, 0, jnp.int32),
    "broadcast_in_dim": lambda x: jnp.broadcast_to(x, (2, 4)),
    "concatenate": lambda x: jnp.concatenate([x, x]),
    "cumlogsumexp": lax.cumlogsumexp,
    "cummax": lax.cummax,
    "cummin": lax.cummin,
    "cumsum": lax.cumsum,
    "cumprod": lambda x: lax.cumprod(near(x)),
    "dot_general": lambda x: jnp.outer(x, x) @ x,
    "dynamic_slice": lambda x: lax.dynamic_slice(x, whole(x)[:1], (2,)),
    "dynamic_update_slice": lambda x: lax.dynamic_update_slice(x, x[:2], whole(x)[:1]),
    "empty": lambda x: lax.empty((2,), jnp.float32) * 0 + x[:2],
    "gather": lambda x: x[whole(x)],
    "iota": lambda x: lax.iota(jnp.int32, 4) + whole(x),
    "pad": lambda x: jnp.pad(x, 2),
    "reduce_and": lambda x: jnp.all(x > 0),
    "reduce_or": lambda x: jnp.any(x > 0),
    "reduce_max": jnp.max,
    "reduce_min": jnp.min,
    "reduce_prod": lambda x: jnp.prod(near(x)),
    "reduce_sum": jnp.sum,
    "reduce_xor": lambda x: lax.reduce_xor(whole(x), (0,)),
    "reduce": lambda x: lax.reduce(x, 0.0, lambda a, b: a + b * b, (0,)),
    "reduce_window": windowed(lambda a, b: a + b * b, 0.0),
    "reduce_window_sum": windowed(lax.add, 0.0),
    "reduce_window_max": windowed(lax.max, -jnp.inf),
    "reduce_window_min": windowed(lax.min, jnp.inf),
    "select_and_gather_add": lambda x: jax.jvp(windowed(lax.max, -jnp.inf), (x,), (x,))[1],
    "select_and_scatter_add": lambda x: jax.grad(lambda v: windowed(lax.max, -jnp.inf)(v).sum())(x),
    "reshape": lambda x: x.reshape(2, 2),
    "rev": lambda x: lax.rev(x, (0,)),
    "slice": lambda x: x[1:3],
    "sort": jnp.sort,
    "split": lambda x: lax.split(x, (1, 3)),
    "squeeze": lambda x: lax.squeeze(x[:1], (0,)),
    "top_k": lambda x: lax.top_k(x, 2)[0],
    "approx_top_k": lambda x: lax.approx_max_k(x, 2)[0],
    "transpose": lambda x: jnp.outer(x, 2 * x).T,
    "conv_general_dilated": lambda x: lax.conv(image(x), jnp.ones((2, 1, 1, 1)), (1, 1), "VALID"),
    "scatter": scattered(lax.scatter),
    "scatter-add": scattered(lax.scatter_add),
    "scatter-sub": scattered(lax.scatter_sub),
    "scatter-mul": scattered(lax.scatter_mul),
    "scatter-max": scattered(lax.scatter_max),
    "scatter-min": scattered(lax.scatter_min),
    "ragged_dot_general": lambda x: lax.ragged_dot(
        jnp.outer(x, x), jnp.ones((2, 4, 2)), jnp.array([2, 2])
    ),
    "fft": lambda x: jnp.abs(jnp.fft.fft(x)),
}
MATRICES = {
    "cholesky": lambda x: jnp.linalg.cholesky(square(x)),
    "eigh": lambda x: jnp.linalg.eigh(square(x))[0],
    "eig": lambda x: jnp.real(jnp.linalg.eigvals(square(x))),
    "lu": lambda x: lax.linalg.lu(square(x))[0],
    "hessenberg": lambda x: lax.linalg.hessenberg(square(x))[0],
    "qr": lambda x: jnp.linalg.qr(square(x))[1],
    "householder_product": lambda x: lax.linalg.householder_product(square(x), near(x)),
    "schur": lambda x: lax.linalg.schur(square(x))[0],
    "svd": lambda x: jnp.linalg.svd(square(x))[1],
    "triangular_solve": lambda x: lax.linalg.triangular_solve(
        square(x), x, left_side=True, lower=True
    ),
    "tridiagonal": lambda x: lax.linalg.tridiagonal(square(x))[0],
    "tridiagonal_solve": lambda x: lax.linalg.tridiagonal_solve(
        0 * x, 3 + near(x), 0 * x, jnp.outer(x, x)
    ),
    "custom_linear_solve": lambda x: jnp.linalg.solve(square(x), x),
    "lu_pivots_to_permutation": lambda x: lax.linalg.lu_pivots_to_permutation(jnp.abs(whole(x)), 4),
    "cholesky_update": lambda x: lax.linalg.cholesky_update(square(x), near(x)),
    "symmetric_product": lambda x: lax.linalg.symmetric_product(square(x), square(x)),
}
CALLED = {
    "cond": lambda x: lax.cond(x[0] > 0, jnp.sin, jnp.cos, x),
    "jit": lambda x: jax.jit(lambda v: 2 * v)(x),
    "scan": lambda x: lax.scan(lambda c, v: (c + v, c * v), x[0], x),
    "remat2": lambda x: jax.checkpoint(jnp.sin)(x),
    "while": lambda x: lax.while_loop(lambda v: v[0] > 0.1, lambda v: v * 0.5, x),
    "custom_jvp_call": own,
    "custom_vjp_call": other,
    "custom_vmap_call": lanes,
    "random_bits": lambda x: jax.random.bits(key(x)),
    "random_split": lambda x: jax.random.bits(jax.random.split(key(x))[1]),
    "random_seed": lambda x: jax.random.bits(key(x)),
    "random_fold_in": lambda x: jax.random.bits(jax.random.fold_in(key(x), 7)),
    "random_wrap": lambda x: jax.random.bits(
        jax.random.wrap_key_data(jnp.abs(whole(x))[:2].astype(jnp.uint32))
    ),
    "random_unwrap": lambda x: jax.random.key_data(key(x)),
    "random_clone": lambda x: jax.random.bits(jax.random.clone(key(x))),
    "threefry2x32": lambda x: threefry_2x32(
        jnp.abs(whole(x))[:2].astype(jnp.uint32), jnp.arange(4, dtype=jnp.uint32)
    ),
    "rng_bit_generator": lambda x: lax.rng_bit_generator(
        jnp.abs(whole(x)).astype(jnp.uint32), (2,)
    )[1],
    "rng_uniform": lambda x: lax.rng_uniform(0.0, 1.0, (2,)) + x[:2],
    "pure_callback": lambda x: jax.pure_callback(lambda v: v, x, x),
    "io_callback": lambda x: io_callback(lambda v: v, x, x),
    "debug_callback": lambda x: (jax.debug.callback(lambda v: None, x), x)[1],
    "debug_print": lambda x: (jax.debug.print("{}", x), x)[1],
    "device_put": lambda x: jax.device_put(x),
    "name": lambda x: checkpoint_name(x, "x"),
    "linear_call": lambda x: jax.custom_derivatives.linear_call(
        lambda r, v: v * r, lambda r, v: v * r, x, x
    ),
    "composite": lambda x: lax.composite(lambda v: v * 2, "some.name")(x),
    "platform_index": lambda x: lax.platform_dependent(x, cpu=jnp.sin, default=jnp.cos),
}
TABLE = {
    **ONE_OPERAND,
    **ARRAYS,
    **MATRICES,
    **CALLED,
    **{name: lambda x, f=f: f(x, x[::-1]) for name, f in TWO_OPERANDS.items()},
}
ELSEWHERE = {
    "between devices, which one simulation does not see": """
        all_gather all_gather_done all_gather_invariant all_gather_reduced all_gather_reduced_start
        all_gather_start all_to_all all_to_all_done all_to_all_start axis_index pbroadcast
        pbroadcast_done pbroadcast_start pmax pmin ppermute ppermute_done ppermute_start precv
        preduced psend psum psum_done psum_invariant psum_invariant_start psum_start pvary
        ragged_all_to_all reduce_scatter reduce_scatter_done reduce_scatter_start
        reduced_vary_cast_p shard_map unreduced_psum unreduced_psum_start
        unreduced_reduce_scatter unreduced_reduce_scatter_start vary_unreduced_cast_p reshard
        sharding_constraint layout_constraint inspect_sharding custom_partitioning
        with_memory_space_constraint pin unpin""",
    "of references and effects, which a pure function has none of": """
        accum_grad_in_ref addupdate after_all box_get box_set core_map create_linear create_token
        dce_sink empty_ref free_ref freeze from_edtype get log_extend log_read new_box new_log
        new_ref run_state swap tie to_edtype unreachable""",
    "of accelerators": """
        cudnn_fusion dot_product_attention_bwd dot_product_attention_bwd_wrapper
        dot_product_attention_fp8_bwd dot_product_attention_fp8_bwd_wrapper
        dot_product_attention_fp8_fwd dot_product_attention_fp8_fwd_wrapper
        dot_product_attention_fwd dot_product_attention_fwd_wrapper scaled_dot scaled_matmul
        scaled_matmul_wrapper geqp3 geqrf ormqr""",
    "without a public function that makes them in a program": """
        broadcast_to call call_hi_primitive check closed_call custom_lin dim_as_value
        dimension_size empty2 eval_jaxpr iota_2x32_shape philox2x32 philox4x32 remat_opt
        select_and_scatter shape_assertion stack stage threefry4x32 tile unstack call_exported
        ffi_call""",
}
"""Primitives that no program of the table has, by the reason."""


def packed(function):
    def of_row(row, *_):
        def bits(value):
            value = jnp.asarray(value)
            short = value.dtype == bool or value.dtype.itemsize < 4
            return (value.astype(jnp.uint32) if short else value.view(jnp.uint32)).ravel()

        return jnp.concatenate([bits(each) for each in jax.tree.leaves(function(row))])

    return of_row


FORMS = (
    jax.ShapeDtypeStruct((4,), jnp.float32),
    jax.ShapeDtypeStruct((2,), jnp.uint32),
    jax.ShapeDtypeStruct((), jnp.int32),
    jax.ShapeDtypeStruct((), jnp.float32),
    jax.ShapeDtypeStruct((1,), jnp.float32),
)


def names_in(program):
    for step in program.eqns:
        yield step.primitive.name
        for inner in programs_in(step):
            yield from names_in(inner)


@pytest.mark.slow
def test_the_table_has_every_primitive():
    done = subprocess.run([sys.executable, "-c", NAMES], capture_output=True, text=True, check=True)
    excluded = set(" ".join(ELSEWHERE.values()).split())
    assert set(done.stdout.split()) <= {*TABLE, *excluded}
    assert not excluded & set(TABLE)


@pytest.mark.slow
def test_programs_of_all_primitives_equal_those_of_xla_or_are_refused_by_name():
    translated, refused, wrong = {}, {}, []
    for name, function in TABLE.items():
        program = jax.make_jaxpr(packed(function))(*FORMS)
        if name not in set(names_in(program.jaxpr)):
            wrong.append(f"the program of {name} has {sorted(set(names_in(program.jaxpr)))}")
        try:
            translate(program)
            translated[name] = function
        except Untranslatable as error:
            refused[name] = str(error)
    assert not wrong
    # Refused for what they are, and not for an error of a rule that was not made for them.
    assert not [name for name, text in refused.items() if "Error" in text]
    known = {*elementary.NAMES, *translation.RULES, *CALLS, *CUSTOM_CALLS}
    assert set(refused) & known == set(), refused

    together = lambda x: [function(x) for function in translated.values()]  # noqa: E731
    program = jax.make_jaxpr(packed(together))(*FORMS)
    count = program.out_avals[0].shape[0]
    library = load(library_name("every primitive"), count, lambda: translate(program))
    rows = np.random.default_rng(0).normal(size=(64, 4)).astype(np.float32)
    zeros = np.zeros(64, np.float32)
    ours = library(rows, np.zeros(2, np.uint32), 0, zeros, zeros[:1], 1)
    theirs = np.asarray(jax.jit(jax.vmap(packed(together)))(rows))
    at = 0
    for name, function in translated.items():
        sizes = [each.size for each in jax.tree.leaves(jax.eval_shape(function, FORMS[0]))]
        mine, other = ours[:, at : at + sum(sizes)], theirs[:, at : at + sum(sizes)]
        at += sum(sizes)
        close = np.isclose(mine.view(np.float32), other.view(np.float32), rtol=1e-5, atol=1e-6)
        if not np.all((mine == other) | close):
            wrong.append(name)
    assert not wrong
