"""Make the files of trees, linear models and quantised networks, with what ONNX Runtime gives.

python -m venv frameworks
frameworks/bin/pip install scikit-learn skl2onnx onnx onnxruntime
frameworks/bin/python tests/addons/rl/policies/make_classical.py
"""

import os
import tempfile
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
from onnx import helper, numpy_helper
from onnxruntime.quantization import QuantFormat, QuantType, quantize_dynamic, quantize_static
from skl2onnx import to_onnx
from sklearn.ensemble import (
    GradientBoostingClassifier,
    RandomForestClassifier,
    RandomForestRegressor,
)
from sklearn.linear_model import LinearRegression, LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import Binarizer, Normalizer, StandardScaler

HERE = Path(__file__).parent / "files"
rng = np.random.default_rng(0)
X = rng.normal(size=(300, 4)).astype(np.float32)
REAL = np.stack([X[:, 0] * 2 + np.sin(X[:, 1] * 3), X[:, 2] * X[:, 3]], 1)
THREE = (X[:, 0] + X[:, 1] > 0).astype(int) + (X[:, 2] > 0.5)
TWO = (X[:, 0] * X[:, 1] > 0).astype(int)
OBSERVATIONS = np.concatenate([rng.normal(size=(16, 4)), X[:16]]).astype(np.float32)


def keep(name, model, output):
    data = model.SerializeToString()
    (HERE / f"{name}.onnx").write_bytes(data)
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    one = session.get_inputs()[0].name
    actions = np.stack([session.run([output], {one: o[None]})[0][0] for o in OBSERVATIONS])
    path = HERE / f"{name}.expected.npz"
    np.savez_compressed(path, observations=OBSERVATIONS, actions=actions)


def keep_sklearn(name, model, wanted, output, **options):
    model.fit(X, wanted)
    told = {id(model): options} if options else {}
    keep(name, to_onnx(model, X[:1], options=told, target_opset={"": 17, "ai.onnx.ml": 3}), output)


keep_sklearn("trees", RandomForestRegressor(4, max_depth=4, random_state=0), REAL, "variable")
boosted = GradientBoostingClassifier(n_estimators=5, random_state=0)
keep_sklearn("boosted", boosted, TWO, "probabilities", zipmap=False)
forest = RandomForestClassifier(3, max_depth=3, random_state=0)
keep_sklearn("forest", forest, THREE, "output_label", zipmap=True)
scaled = make_pipeline(StandardScaler(), Normalizer("l2"), LogisticRegression())
keep_sklearn("logistic", scaled, THREE, "probabilities", zipmap=False)
keep_sklearn(
    "linear", make_pipeline(Binarizer(threshold=0.2), LinearRegression()), REAL, "variable"
)


def network(biased):
    nodes, tensors, x = [], [], "x"
    for i, shape in enumerate(((4, 8), (8, 2))):
        tensors.append(numpy_helper.from_array(rng.normal(size=shape).astype(np.float32), f"w{i}"))
        nodes.append(helper.make_node("MatMul", [x, f"w{i}"], [x := f"m{i}"]))
        if biased:
            bias = rng.normal(size=shape[1]).astype(np.float32)
            tensors.append(numpy_helper.from_array(bias, f"b{i}"))
            nodes.append(helper.make_node("Add", [x, f"b{i}"], [x := f"a{i}"]))
        if i == 0:
            nodes.append(helper.make_node("Relu", [x], [x := "r"]))
    ends = [[helper.make_tensor_value_info(n, 1, ["N", k])] for n, k in (("x", 4), (x, 2))]
    graph = helper.make_graph(nodes, "network", *ends, tensors)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)]), "plain.onnx")
    return x


class Calibration:
    def __init__(self):
        self.left = iter([{"x": X[k : k + 10]} for k in range(0, 100, 10)])

    def get_next(self):
        return next(self.left, None)


os.chdir(tempfile.mkdtemp())
last = network(biased=True)
quantize_dynamic("plain.onnx", "made.onnx")
keep("quantised_dynamic", onnx.load("made.onnx"), last)
kinds = {"activation_type": QuantType.QInt8, "weight_type": QuantType.QInt8}
quantize_static(
    "plain.onnx", "made.onnx", Calibration(), QuantFormat.QDQ, per_channel=True, **kinds
)
keep("quantised_pairs", onnx.load("made.onnx"), last)
last = network(biased=False)
quantize_static("plain.onnx", "made.onnx", Calibration(), QuantFormat.QOperator)
keep("quantised_matmul", onnx.load("made.onnx"), last)
