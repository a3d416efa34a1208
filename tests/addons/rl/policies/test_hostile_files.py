"""Files that are damaged, or made to do harm: one clear line each, and nothing is executed."""

import contextlib
import json
import os
import pickle
import struct
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import pytest
from mutated import limited
from onnx import TensorProto, helper, numpy_helper

from verifai_jax.addons.rl.policies import PolicyError, policy
from verifai_jax.addons.rl.policies.pickled import Name, Record, array_of, read_pickle

FILES = Path(__file__).parent / "files"


class Harm:
    def __init__(self, file):
        self.file = file

    def __reduce__(self):
        return os.system, (f"touch {self.file}",)


def test_pickled_code_is_read_and_not_run(tmp_path):
    record = read_pickle(pickle.dumps(Harm(tmp_path / "ran")), "it")
    assert record.function.name == "system"
    assert record.arguments == (f"touch {tmp_path / 'ran'}",)
    with zipfile.ZipFile(tmp_path / "bad.pt", "w") as archive:
        archive.writestr("bad/data.pkl", pickle.dumps({"a.weight": Harm(tmp_path / "ran")}))
    with pytest.raises(PolicyError, match="holds no tensors by name"):
        policy(tmp_path / "bad.pt", activation="tanh")
    (tmp_path / "scale.pkl").write_bytes(pickle.dumps(Harm(tmp_path / "ran")))
    with pytest.raises(PolicyError, match=r"not a file of VecNormalize\.save"):
        policy(lambda x: x, normalise=tmp_path / "scale.pkl")
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_pickles_are_read_as_values(protocol):
    values = {"a": [1, -(2**40), 2.5, True, None], "b": (b"\x00\xff", "text"), 3: {"c": ()}}
    assert read_pickle(pickle.dumps(values, protocol), "it") == values
    for array in (np.arange(6.0).reshape(2, 3), np.int32([[1], [2]]), np.float32(3.5)):
        read = array_of(read_pickle(pickle.dumps(array, protocol), "it"))
        np.testing.assert_array_equal(read, array)
    assert read_pickle(pickle.dumps(Path, protocol), "it").name == "Path"
    assert isinstance(read_pickle(pickle.dumps(Path("a"), protocol), "it"), Record | Name)


def test_damaged_bytes_are_one_clear_line(tmp_path):
    rng = np.random.default_rng(0)
    for name in ("ppo.zip", "mlp.onnx", "mlp.pt", "mlp.safetensors"):
        whole = (FILES / name).read_bytes()
        options = {} if name in ("ppo.zip", "mlp.onnx") else {"activation": "elu"}
        for cut in rng.integers(0, len(whole), 8):
            file = tmp_path / name
            file.write_bytes(whole[:cut])
            with pytest.raises(PolicyError) as error:
                policy(file, **options)
            assert "\n" not in str(error.value)
            flipped = bytearray(whole)
            flipped[cut] ^= 0xFF
            file.write_bytes(flipped)
            # Weights may have changed; anything else is refused.
            with contextlib.suppress(PolicyError):
                policy(file, **options)


def test_an_archive_that_unpacks_to_gigabytes(tmp_path):
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("policy.pth", b"")
        with archive.open("data", "w", force_zip64=True) as file:
            for _ in range(200):
                file.write(bytes(1_000_000))
    with pytest.raises(PolicyError, match="unpacks to 200 MB; at most 150 MB are read"):
        policy(tmp_path / "bomb.zip")


def test_a_header_of_four_gigabytes(tmp_path):
    file = tmp_path / "huge.safetensors"
    file.write_bytes(struct.pack("<Q", 2**32) + b"{}")
    with pytest.raises(PolicyError, match="holds no tensors"):
        policy(file, activation="tanh")
    header = json.dumps(
        {"a.weight": {"dtype": "F32", "shape": [2**16, 2**16], "data_offsets": [0, 8]}}
    )
    file.write_bytes(struct.pack("<Q", len(header)) + header.encode() + bytes(8))
    with pytest.raises(PolicyError, match="holds no tensors"):
        policy(file, activation="tanh")


def graph(nodes, file, initializers=(), outputs=("y",), opset=17):
    value = lambda name: helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 2])  # noqa: E731
    made = helper.make_graph(nodes, "g", [value("x")], [value(n) for n in outputs], initializers)
    onnx.save(helper.make_model(made, opset_imports=[helper.make_opsetid("", opset)]), file)
    return file


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        (
            [("Relu", ["z"], ["y"]), ("Relu", ["y"], ["z"])],
            "reads 'z', which no node before it computes",
        ),
        ([("FFT", ["x"], ["y"])], r"uses FFT, which is not supported \(node 'y'\)"),
        ([("Relu", ["x"], ["z"])], "no node computes its output 'y'"),
    ],
)
def test_graphs_that_are_none(tmp_path, nodes, message):
    file = graph([helper.make_node(*node) for node in nodes], tmp_path / "bad.onnx")
    with pytest.raises(PolicyError, match=message):
        policy(file)


def doubled(count):
    nodes = [("Concat", ["x", "x"], ["v0"])]
    nodes += [("Concat", [f"v{i}", f"v{i}"], [f"v{i + 1}"]) for i in range(count)]
    return [helper.make_node(*n, axis=0) for n in nodes] + [
        helper.make_node("ReduceSum", [f"v{count}"], ["y"])
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("nodes", "shape"),
    [
        ([("ConstantOfShape", ["s"], ["z"])], [100_000, 100_000]),
        ([("Expand", ["x", "s"], ["z"])], [100_000, 100_000, 2]),
        ([("Tile", ["x", "s"], ["z"])], [100_000, 100_000]),
        ([("Pad", ["x", "s"], ["z"])], [0, 0, 100_000, 100_000]),
        ([("Gather", ["x", "s"], ["w"]), ("Gather", ["w", "s"], ["z"])], [0] * 9_000_000),
        (doubled(40), [1]),
    ],
)
def test_small_graphs_that_compute_gigabytes(tmp_path, nodes, shape):
    if isinstance(nodes[0], tuple):
        nodes = [helper.make_node(*node) for node in [*nodes, ("ReduceSum", ["z"], ["y"])]]
    sizes = onnx.numpy_helper.from_array(np.array(shape, np.int64), "s")
    loaded = policy(graph(nodes, tmp_path / "bomb.onnx", [sizes]))
    with pytest.raises(
        PolicyError, match="numbers; the graph of a policy may compute at most 16,777,216"
    ):
        loaded.act(np.zeros(2, np.float32))


def test_tensors_are_read_from_the_folder_of_the_model_only(tmp_path):
    tensor = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[2])
    tensor.data_location = TensorProto.EXTERNAL
    for location, message in (
        ("../secret.bin", "not a file next to the model"),
        ("/etc/passwd", "not a file next to the model"),
        ("weights.bin", "smaller than the model says"),
    ):
        del tensor.external_data[:]
        tensor.external_data.add(key="location", value=location)
        (tmp_path / "weights.bin").write_bytes(bytes(4))
        file = graph([helper.make_node("Add", ["x", "w"], ["y"])], tmp_path / "far.onnx", [tensor])
        with pytest.raises(PolicyError, match=message):
            policy(file)
    apart = tmp_path.with_name(f"{tmp_path.name}.apart")
    apart.mkdir()
    (tmp_path / "weights.bin").rename(apart / "weights.bin")
    (tmp_path / "weights.bin").symlink_to(apart / "weights.bin")
    with pytest.raises(PolicyError, match=r"weights\.bin is a link out of"):
        policy(file)
    (tmp_path / "weights.bin").unlink()
    (tmp_path / "weights.bin").write_bytes(np.float32([1, 2]).tobytes())
    np.testing.assert_array_equal(policy(file).act(np.zeros(2, np.float32)), [1, 2])


def test_what_is_wrong_is_said(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no file"):
        policy(tmp_path / "absent.onnx")
    (tmp_path / "model.txt").write_text("")
    with pytest.raises(PolicyError, match=r"has to be one of \.zip, \.onnx"):
        policy(tmp_path / "model.txt")
    with pytest.raises(PolicyError, match="use_sde=True: export it as ONNX"):
        policy(FILES / "sac_sde.zip")
    with pytest.raises(PolicyError, match="give activation= for an MLP"):
        policy(FILES / "mlp.pt")
    with pytest.raises(PolicyError, match="leave out activation="):
        policy(FILES / "ppo.zip", activation="tanh")
    with pytest.raises(PolicyError, match="takes observations of 4 numbers; got shape"):
        policy(FILES / "ppo.zip").act(np.zeros(5, np.float32))


def test_shared_tuples_and_references(tmp_path):
    value = ()
    for _ in range(25):
        value = (value, value)
    wide = {"w": np.zeros(1)}
    for _ in range(8):
        wide = [wide] * 40
    for content in (value, wide, {((),): 1}):
        data = pickle.dumps({"a": content})
        assert len(data) < 1000
        with zipfile.ZipFile(tmp_path / "it.pt", "w") as archive:
            archive.writestr("it/data.pkl", data)
        with limited(), pytest.raises(PolicyError, match=r"refers to more than|is neither a text"):
            policy(tmp_path / "it.pt", activation="elu")


def huge(nodes, tmp_path, initializers=(), opset=17):
    file = graph(nodes, tmp_path / "huge.onnx", list(initializers), opset=opset)
    with limited(), pytest.raises(PolicyError) as error:
        jax.eval_shape(policy(file).act, jnp.zeros(2))
    return str(error.value)


@pytest.mark.slow
def test_results_are_bounded_before_they_are_computed(tmp_path):
    many = numpy_helper.from_array(np.array([2**24 - 10], np.int64), "many")
    zeros = helper.make_node("ConstantOfShape", ["many"], ["zeros"])
    joined = helper.make_node("Concat", ["zeros"] * 30, ["y"], axis=0)
    assert "the graph of a policy may compute at most" in huge([zeros, joined], tmp_path, [many])
    split = helper.make_node("Split", ["x"], ["y", "z"], num_outputs=10**8, axis=1)
    assert "which are not its num_outputs" in huge([split], tmp_path, opset=18)
    pooled = helper.make_node("Reshape", ["x", "image"], ["i"])
    image = numpy_helper.from_array(np.array([1, 1, 2], np.int64), "image")
    pool = helper.make_node(
        "AveragePool", ["i"], ["y"], kernel_shape=[2**31], auto_pad="SAME_UPPER", strides=[1]
    )
    assert "may compute at most" in huge([pooled, pool], tmp_path, [image])


def test_infinite_weights_and_two_of_one_name(tmp_path):
    weights = numpy_helper.from_array(np.full((2, 2), np.inf, np.float32), "w")
    node = helper.make_node("MatMul", ["x", "w"], ["y"])
    assert "'w' of" in (told := huge([node], tmp_path, [weights]))
    assert "holds infinite weights" in told
    ones = numpy_helper.from_array(np.ones((2, 2), np.float32), "w")
    assert "two tensors that are called 'w'" in huge([node], tmp_path, [ones, weights])
    bounds = numpy_helper.from_array(np.array(np.inf, np.float32), "high")
    clip = helper.make_node("Clip", ["x", "", "high"], ["y"])
    file = graph([clip], tmp_path / "clip.onnx", [bounds])
    assert policy(file).act(np.zeros(2)).shape == (2,)
