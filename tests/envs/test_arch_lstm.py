"""SB's networks against NumPy, and how their files are read, on networks made here."""

import io
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.io import savemat

import verifai_jax as vj
from envs.arch.lstm import HEADER, STEPS, Lstm, read_lstm
from specs.arch import lstm as specs
from verifai_jax.core.values.waveform import Waveform

INPUTS = {"sb1": (2, 1), "sb2": (1, 1), "sb3": (2, 1), "sb4": (2, 2), "sb5": (1, 2)}


def weights(inputs=2, outputs=1, units=5, seed=0):
    rng = np.random.default_rng(seed)
    shapes = [(4 * units, inputs), (4 * units, units), (4 * units,), (outputs, units), (outputs,)]
    return [rng.normal(size=shape) for shape in shapes]


def saved(path, layers):
    """Write layers as MATLAB does with objects: a file within a nameless variable of bytes."""

    def variable(value):
        file = io.BytesIO()
        savemat(file, {"x": value})
        header, rest = file.getvalue()[:128], file.getvalue()[128:]
        # The name, one character in a short element, becomes an empty one.
        named = rest.index(b"\x01\x00\x01\x00x\x00\x00\x00")
        return header, rest[:named] + b"\x01\x00\x00\x00\x00\x00\x00\x00" + rest[named + 8 :]

    header, inner = variable(layers)
    body = b"\x00\x01IM" + bytes(4) + inner + bytes(96)
    _, outer = variable(np.frombuffer(body, np.uint8)[None])
    path.write_bytes(header[:HEADER] + b"\x00\x01IM" + outer)
    return path


def layers_of(inputs, recurrent, bias, dense, dense_bias):
    def learned(value):
        return {"Version": 2.0, "Value": value.astype(np.float32)}

    lstm = {
        "Name": "lstm",
        "InputWeights": learned(inputs),
        "RecurrentWeights": learned(recurrent),
        "Bias": learned(bias[:, None]),
    }
    last = {
        "Name": "fc",
        "OutputSize": float(len(dense)),
        "Weights": learned(dense),
        "Bias": learned(dense_bias[:, None]),
    }
    cells = np.empty((4, 1), object)
    cells[:, 0] = [np.zeros(3), {"Name": "sequenceinput"}, lstm, last]
    return {"MCOS": cells}


def by_loops(u, inputs, recurrent, bias, dense, dense_bias):
    """Hochreiter and Schmidhuber's cell with a forget gate, unit by unit."""

    def sigmoid(x):
        return 1 / (1 + np.exp(-x))

    units = recurrent.shape[1]
    h, c, outputs = np.zeros(units), np.zeros(units), []
    for x in u:
        before = h.copy()
        for j in range(units):
            gates = [
                inputs[k * units + j] @ x + recurrent[k * units + j] @ before + bias[k * units + j]
                for k in range(4)
            ]
            c[j] = sigmoid(gates[1]) * c[j] + sigmoid(gates[0]) * np.tanh(gates[2])
            h[j] = sigmoid(gates[3]) * np.tanh(c[j])
        outputs.append(dense @ h + dense_bias)
    return np.array(outputs)


def test_equations_against_numpy():
    own, pieces = weights(2, 2), np.random.default_rng(1).random((2, 4))
    features = {f"u{i + 1}": Waveform(jnp.asarray(p), "constant") for i, p in enumerate(pieces)}
    trace = jax.jit(Lstm(*own))(features)
    # Four pieces of 6 s; the sample at 24 s belongs to the last.
    u = pieces[:, np.minimum(np.arange(STEPS + 1) // 6, 3)].T
    expected = by_loops(u, *own)
    for i, name in enumerate(("b1", "b2")):
        np.testing.assert_allclose(trace.signals[name], expected[:, i], atol=1e-5)
    assert trace.dt == 1.0


def test_a_file_is_read(tmp_path):
    own = weights()
    lstm = read_lstm(saved(tmp_path / "net.mat", layers_of(*own)))
    found = (lstm.inputs, lstm.recurrent, lstm.bias, lstm.dense, lstm.dense_bias)
    for one, other in zip(found, own, strict=True):
        np.testing.assert_array_equal(one, other.astype(np.float32))
    assert (lstm.features, lstm.signals) == (("u1", "u2"), ("b",))


def test_what_is_no_such_file_is_refused(tmp_path):
    other, plain = tmp_path / "other.mat", tmp_path / "plain.mat"
    other.write_bytes(b"nothing of the kind")
    savemat(plain, {"x": np.ones(3)})
    with pytest.raises(ValueError, match=r"there is no file .*missing\.mat"):
        read_lstm(tmp_path / "missing.mat")
    for path in (other, plain):
        with pytest.raises(ValueError, match=rf"{path.name} is no MATLAB file with a network"):
            read_lstm(path)
    two = {"MCOS": np.array([[layers_of(*weights())], [layers_of(*weights())]], object)}
    with pytest.raises(ValueError, match="one LSTM layer and one dense layer; got 2 and 2"):
        read_lstm(saved(tmp_path / "two.mat", two))
    with pytest.raises(ValueError, match="fit no LSTM layer of 5 units"):
        replace(Lstm(*weights()), dense_bias=np.zeros(2))
    with pytest.raises(ValueError, match="brake"):
        Lstm(*weights())({"brake": 0.5})


def test_the_problems_of_a_folder(tmp_path):
    for name, file in specs.FILES.items():
        saved(tmp_path / file, layers_of(*weights(*INPUTS[name])))
    problems = specs.from_folder(tmp_path)
    assert [problem.name for problem in problems] == list(specs.FILES)
    for problem in problems:
        problem.check()
        assert problem.space.dim == 4 * INPUTS[problem.name][0]
        for formula in problem.formulas.values():
            assert formula.horizon() <= STEPS
    # Without a folder the file can be read all the same, and defines none.
    assert not any(isinstance(value, vj.Problem) for value in vars(specs).values())
