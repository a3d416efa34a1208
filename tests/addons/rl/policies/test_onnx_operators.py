"""Operators of ONNX on all their types, against ONNX's own evaluator and values by hand."""

import jax.numpy as jnp
import ml_dtypes
import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper
from onnx.reference import ReferenceEvaluator

from verifai_jax.addons.rl.policies.errors import PolicyError
from verifai_jax.addons.rl.policies.onnx_graph import read_onnx

INTEGERS = (np.int8, np.int16, np.int32, np.int64, np.uint8, np.uint16, np.uint32, np.uint64)
SELDOM = {np.int16, np.uint16, np.uint32, np.uint64, np.int8}
RNG = np.random.default_rng(0)


def model(operator, inputs, opset=18, outputs=1, **attributes):
    """Return a model of one node; arrays in a list are constants, others are fed."""
    names = ["" if x is None else f"i{k}" for k, x in enumerate(inputs)]
    given = dict(zip(names, inputs, strict=True))
    constants = [
        numpy_helper.from_array(np.asarray(x[0]), n)
        for n, x in given.items()
        if isinstance(x, list)
    ]
    fed = {n: np.asarray(x) for n, x in given.items() if n and not isinstance(x, list)}
    fed = fed or {"any": np.zeros(1, np.float32)}
    made = [f"o{k}" for k in range(outputs)]
    node = helper.make_node(operator, names, made, **attributes)
    forms = [
        helper.make_tensor_value_info(n, helper.np_dtype_to_tensor_dtype(x.dtype), x.shape)
        for n, x in fed.items()
    ]
    graph = helper.make_graph(
        [node], "g", forms, [helper.make_empty_tensor_value_info(n) for n in made], constants
    )
    opsets = [helper.make_opsetid("", opset)]
    return helper.make_model(graph, opset_imports=opsets, ir_version=10), fed


def computed(made, fed, output=0):
    graph, weights, _ = read_onnx(
        None, made.SerializeToString(), "net", output=f"o{output}", memory={}
    )
    return np.asarray(graph(weights, fed, None)[0])


def agrees(operator, inputs, opset=18, outputs=1, **attributes):
    made, fed = model(operator, inputs, opset, outputs, **attributes)
    right = ReferenceEvaluator(made).run(None, fed)
    for k, wanted in enumerate(right):
        found = computed(made, fed, k)
        assert found.shape == wanted.shape
        if wanted.dtype.kind in "iub":
            assert found.dtype.kind == wanted.dtype.kind
            assert found.astype(object).tolist() == wanted.astype(object).tolist()
        else:
            tolerance = 4e-3 if wanted.dtype.itemsize == 2 else 1e-5
            np.testing.assert_allclose(found, wanted, rtol=tolerance, atol=tolerance)


def whole(kind, *shape, low=-5, high=6):
    return RNG.integers(max(low, np.iinfo(kind).min), high, shape).astype(kind)


@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=pytest.mark.slow if k in SELDOM else ()) for k in INTEGERS]
)
def test_whole_numbers_stay_what_they_are(kind):
    a, b = whole(kind, 3, 4), whole(kind, 4)
    b = np.where(b == 0, 3, b).astype(kind)
    large = np.array([100, 101, 102], kind)
    cases = [("Mul", [large, large]), ("Mod", [a, b]), ("Max", [a, b]), ("Less", [a, b])]
    cases += [("Reshape", [a, [np.array([2, -1])]]), ("Where", [a > 2, a, b]), ("Add", [[a], b])]
    cases += [("Clip", [a, None, [np.array(3, kind)]])]
    if np.dtype(kind).itemsize >= 4:
        cases += [("ReduceSum", [a, [np.array([0])]]), ("MatMul", [a, a.T.copy()])]
        cases += [
            ("ReduceMax", [a, [np.array([-1])]]),
            ("ReduceL1", [a]),
            ("Gemm", [a, a.T.copy(), a[:, 0]]),
        ]
    if np.dtype(kind).kind == "i":
        cases += [("Abs", [a]), ("Neg", [a]), ("Sign", [a])]
    for operator, inputs in cases:
        agrees(operator, inputs)
    agrees("Mod", [a, b], fmod=1)
    # Towards zero, as in C; the evaluator of ONNX rounds down.
    made, fed = model("Div", [a, b])
    assert computed(made, fed).tolist() == np.trunc(a / b.astype(float)).astype(kind).tolist()


def test_beyond_24_bits_whole_numbers_are_exact():
    a = np.array([16_777_217, 123_456_789, -33_554_433], np.int32)
    for kind in (np.int32, np.int64):
        for operator in ("Add", "Sub", "Max"):
            agrees(operator, [a.astype(kind), np.array([1, 3, 5], kind)])
    made, fed = model("Div", [a, np.array([1, 1, 5], np.int32)])
    assert computed(made, fed).tolist() == [16_777_217, 123_456_789, -6_710_886]
    agrees("ReduceSum", [a])


def test_64_bits_are_never_cut_without_a_word():
    far = np.array([2**40], np.int64)
    for inputs in ([far, far], [np.array([1]), [far]]):
        made, fed = model("Add", inputs)
        with pytest.raises(PolicyError, match="whole numbers beyond int32, such as 1099511627776"):
            computed(made, fed)
    # What depends on the observation cannot be refused: the action is then no number.
    product = [
        helper.make_node("Mul", ["x", "x"], ["y"]),
        helper.make_node("Cast", ["y"], ["z"], to=1),
    ]
    form = helper.make_tensor_value_info("x", onnx.TensorProto.INT64, [2])
    graph = helper.make_graph(product, "g", [form], [helper.make_empty_tensor_value_info("z")])
    data = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)]).SerializeToString()
    square, weights, _ = read_onnx(None, data, "net", output=None, memory={})
    assert square(weights, np.array([3, 2]), None)[0].tolist() == [9.0, 4.0]
    assert np.all(np.isnan(square(weights, np.array([3, 2**17]), None)[0]))


@pytest.mark.parametrize(
    ("operator", "inputs", "attributes", "right"),
    [
        ("Pow", [np.int32([2, -2, 1]), np.int32([-1, 3, -3])], {}, [0, -8, 1]),
        ("Cast", [np.float32([300.7, -1.7, 2.5])], {"to": 2}, [44, 255, 2]),
        ("Cast", [np.float32([70000.0])], {"to": 10}, [np.inf]),
        ("Cast", [np.float32([1.001])], {"to": 16}, [float(ml_dtypes.bfloat16(1.001))]),
        ("ReduceMean", [np.int32([7, -2, -7])], {"keepdims": 0}, 0),
        ("Clip", [np.float32([np.inf, 2])], {}, [np.finfo(np.float32).max, 2]),
        ("Gather", [np.float32([1, 2]), np.int64([-1, 5])], {}, [2, np.nan]),
    ],
)
def test_values_by_hand(operator, inputs, attributes, right):
    made, fed = model(operator, inputs, **attributes)
    np.testing.assert_array_equal(computed(made, fed), right)


def reals(*shape, kind=np.float32):
    return RNG.normal(size=shape).astype(kind)


@pytest.mark.slow
def test_shapes_modes_and_missing_inputs():
    x = reals(2, 3, 4)
    for noop in (0, 1):
        for operator in ("ReduceL1", "ReduceL2", "ReduceSum", "ReduceMean", "ReduceMax"):
            agrees(operator, [x, [np.zeros(0, np.int64)]], noop_with_empty_axes=noop)
    for starts, ends, step in ((-1, -9, -1), (9, 0, -2), (2**62, -(2**62), -1)):
        agrees("Slice", [x, *([np.array([n])] for n in (starts, ends, 2, step))])
    # A start before the first entry is the first one, going backwards too.
    made, fed = model("Slice", [x, *([np.array([n])] for n in (-100, -200, 2, -1))])
    assert np.array_equal(computed(made, fed), x[:, :, :1])
    for mode in ("constant", "reflect", "edge", "wrap"):
        agrees("Pad", [x, [np.array([0, 1, 2, 0, 0, 1])]], opset=19, mode=mode)
    agrees("Pad", [x, [np.array([1, 0])], None, [np.array([-1])]], opset=19)
    made, fed = model("Pad", [x, [np.array([0, -1, 1, 0, 0, -1])]])
    assert np.array_equal(computed(made, fed), np.pad(x[:, 1:, :-1], ((0, 0), (0, 0), (1, 0))))
    assert computed(*model("Flatten", [reals(0, 3)])).shape == (0, 3)
    x, index = reals(3, 4), np.array([[-1, 0], [2, 1]])
    made, fed = model("GatherElements", [x, [index]], axis=1)
    assert np.array_equal(computed(made, fed), np.take_along_axis(x[:2], index, 1))
    agrees("ReduceMax", [reals(0, 3), [np.array([0])]], opset=20)
    x = whole(np.int8, 1, 1, 4, 4)
    made, fed = model("MaxPool", [x], kernel_shape=[2, 2], strides=[2, 2])
    assert np.array_equal(computed(made, fed), x.reshape(1, 1, 2, 2, 2, 2).max(axis=(3, 5)))
    agrees("LayerNormalization", [reals(2, 4, kind=np.float16), [reals(4, kind=np.float16)]])


@pytest.mark.parametrize(("operator", "gates"), [("LSTM", 4), ("GRU", 3), ("RNN", 1)])
@pytest.mark.parametrize("direction", ["reverse", "bidirectional"])
@pytest.mark.slow
def test_sequences_end_where_their_lengths_say(operator, gates, direction):
    """Each sequence is that of its own length alone; what comes after is zero."""
    both, time, hidden = 1 + (direction == "bidirectional"), 4, 3
    weights = [[reals(both, gates * hidden, 2)], [reals(both, gates * hidden, hidden)]]
    bias, x, lengths = (
        [reals(both, 2 * gates * hidden)],
        reals(time, 2, 2),
        np.array([4, 2], np.int32),
    )
    options = {"hidden_size": hidden, "direction": direction, "outputs": 2}
    made, fed = model(operator, [x, *weights, bias, [lengths]], **options)
    for row, length in enumerate(lengths):
        alone = model(operator, [x[:length, row : row + 1], *weights, bias], **options)
        for output in (0, 1):
            found, right = computed(made, fed, output), computed(*alone, output)
            if output == 0:
                assert not found[length:, :, row].any()
                found = found[:length]
            np.testing.assert_allclose(found[..., row : row + 1, :], right, atol=1e-6)


@pytest.mark.parametrize(
    ("operator", "inputs", "opset", "attributes", "message"),
    [
        ("Sqrt", [np.int32([4])], 18, {}, r"Sqrt.*unsupported type: tensor\(int32\)"),
        ("Add", [np.int32([4]), np.int64([4])], 18, {}, "Add.*inconsistent type"),
        ("Gather", [reals(3), reals(1)], 18, {}, r"Gather.*unsupported type: tensor\(float\)"),
        ("Add", [reals(3), reals(3)], 18, {"axis": 1}, r"Add.*\['axis'\], no attributes in op"),
        ("Gelu", [reals(3)], 18, {}, "Gelu.*is not in operator set 18"),
        ("Add", [reals(3), reals(3)], 6, {}, "has operator set 6; 7 to 26 are supported"),
        ("Mod", [reals(3), reals(3)], 18, {}, "Mod.* has fmod=0, which is for whole numbers"),
        ("Cast", [reals(3)], 19, {"to": 17}, "type"),
        ("Gather", [reals(3), [np.int64([5])]], 18, {}, "index beyond the 3 entries"),
        ("MaxPool", [reals(1, 1, 5)], 12, {"kernel_shape": [2], "dilations": [2],
         "auto_pad": "SAME_UPPER"}, "auto_pad=SAME_UPPER with dilations"),
    ],
)  # fmt: skip
def test_what_the_page_of_an_operator_does_not_have_is_refused(
    operator, inputs, opset, attributes, message
):
    made, fed = model(operator, inputs, opset, **attributes)
    with pytest.raises(PolicyError, match=message):
        computed(made, fed)


def test_a_second_output_that_is_not_computed_is_refused():
    made, fed = model("MaxPool", [reals(1, 1, 4)], outputs=2, kernel_shape=[2])
    with pytest.raises(PolicyError, match="'o1' is an output that is not supported"):
        computed(made, fed, 1)


def test_half_precision_is_rounded_and_the_action_is_not():
    made, fed = model("Add", [np.float16([2048.0]), np.float16([1.0])])
    found = computed(made, fed)
    assert (found.dtype, found.tolist()) == (jnp.float32, [2048.0])
