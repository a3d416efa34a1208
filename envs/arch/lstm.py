"""SB: networks with memory that were trained to break a requirement rarely; weights by path.

    lstm = read_lstm("phi1_m2_vr001_k5_2.mat")          # features u1, u2
    lstm({"u1": 0.5, "u2": 0.5}).signals["b"]           # 25 samples, a second apart

Features, functions of time or numbers: `u1` and, where the network has two inputs, `u2`, 0 to 1.
Signals: `b`, or `b1`, `b2`, ... where it has several outputs; the first sample is the response to
the inputs at time 0.

Source: FalBenchGen's networks of ARCH-COMP 2025, MATLAB `SeriesNetwork`s of one LSTM layer and one
dense layer. They carry no licence, so that none is here: `read_lstm` reads the file that a user
has. The equations are those of MATLAB's `lstmLayer`, gates in the order input, forget, candidate,
output, all states zero at first.
"""

import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from envs.arch.stepped import real, value
from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.values.trace import Trace
from verifai_jax.core.values.waveform import set_durations
from verifai_jax.systems.base import Seed, System

STEPS = 24
"""Seconds that are simulated; there is a sample at each, the first at 0."""

HEADER = 124
"""Bytes of a MATLAB file before its version and byte order."""


@dataclass(frozen=True, eq=False)
class Lstm(System):
    """One LSTM layer and one dense layer, driven by signals in `[0, 1]`.

    **Arguments:**

    - `inputs`: weights of the inputs, gates one after the other: input, forget, candidate, output.
    - `recurrent`: weights of the units' outputs a sample before.
    - `bias`: of the gates.
    - `dense`, `dense_bias`: of the layer that makes the signals.

    **Raises:** `ValueError` for weights whose shapes do not fit.
    """

    inputs: Float[np.ndarray, "gates inputs"]
    recurrent: Float[np.ndarray, "gates units"]
    bias: Float[np.ndarray, " gates"]
    dense: Float[np.ndarray, "outputs units"]
    dense_bias: Float[np.ndarray, " outputs"]

    def __post_init__(self) -> None:
        units = self.recurrent.shape[1]
        shapes = [each.shape for each in (self.inputs, self.recurrent, self.bias)]
        shapes += [self.dense.shape, self.dense_bias.shape]
        outputs = (len(self.dense),)
        fitting = [(4 * units, self.inputs.shape[1]), (4 * units, units), (4 * units,)]
        fitting += [(len(self.dense), units), outputs]
        if shapes != fitting:
            raise ValueError(f"these weights fit no LSTM layer of {units} units: {shapes}")

    @property
    def duration(self) -> float:
        """Simulated seconds."""
        return float(STEPS)

    @property
    def exact_step(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """True: the second from sample to sample is part of the network."""
        return True

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return tuple(f"u{i + 1}" for i in range(self.inputs.shape[1]))

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the outputs."""
        count = len(self.dense)
        return ("b",) if count == 1 else tuple(f"b{i + 1}" for i in range(count))

    def check(self, features: Mapping[str, Any]) -> None:
        """Refuse features that are no inputs of the network; it would ignore them."""
        check_names("feature", features, self.features)

    def __call__(self, features: Mapping[str, Any], key: Seed = None) -> Trace:
        """Simulate once; nothing is random."""
        self.check(features)
        features = set_durations(dict(features), self.duration)
        times = jnp.arange(STEPS + 1, dtype=real())
        u = jax.vmap(lambda t: jnp.stack([value(features[name], t) for name in self.features]))(
            times
        )
        # What does not depend on the state, for all samples at once.
        driven = u @ jnp.asarray(self.inputs, real()).T + jnp.asarray(self.bias, real())
        recurrent = jnp.asarray(self.recurrent, real()).T

        def advance(state: tuple[Any, Any], drive: Any) -> tuple[tuple[Any, Any], Any]:
            output, cell = state
            i, f, g, o = jnp.split(drive + output @ recurrent, 4)
            cell = jax.nn.sigmoid(f) * cell + jax.nn.sigmoid(i) * jnp.tanh(g)
            output = jax.nn.sigmoid(o) * jnp.tanh(cell)
            return (output, cell), output

        zero = jnp.zeros(self.recurrent.shape[1], real())
        _, outputs = jax.lax.scan(advance, (zero, zero), driven)
        made = outputs @ jnp.asarray(self.dense, real()).T + jnp.asarray(self.dense_bias, real())
        return Trace({name: made[:, i] for i, name in enumerate(self.signals)}, dt=1.0)


def read_lstm(path: str | Path) -> Lstm:
    """Read a `SeriesNetwork` of one LSTM layer and one dense layer from a MATLAB file.

    Objects lie in the part of the file that MATLAB calls the subsystem: again a MATLAB file,
    without most of its header. Numbers and text are read, nothing is run.

    **Raises:** `ValueError` where there is no such file, or another network in it.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"there is no file {path}: give the path of a .mat file of FalBenchGen")
    try:
        fields = list(_fields(_subsystem(path)))
    except (MatReadError, ValueError, KeyError, TypeError, NotImplementedError, OSError) as error:
        raise ValueError(f"{path} is no MATLAB file with a network in it: {error}") from error
    lstm = [each for each in fields if {"InputWeights", "RecurrentWeights", "Bias"} <= each.keys()]
    dense = [each for each in fields if {"Weights", "Bias", "OutputSize"} <= each.keys()]
    if len(lstm) != 1 or len(dense) != 1:
        raise ValueError(
            f"{path} must hold one LSTM layer and one dense layer; got {len(lstm)} and {len(dense)}"
        )
    inputs, recurrent, bias = (
        _learned(lstm[0][name]) for name in ("InputWeights", "RecurrentWeights", "Bias")
    )
    weights, offset = (_learned(dense[0][name]) for name in ("Weights", "Bias"))
    return Lstm(inputs, recurrent, bias.ravel(), weights, offset.ravel())


def _subsystem(path: Path) -> np.ndarray:
    """Return the first variable of the subsystem of a MATLAB file."""
    nameless = "__function_workspace__"
    inner = loadmat(path)[nameless].tobytes()
    size = int.from_bytes(inner[12:16], "little" if inner[2:4] == b"IM" else "big")
    with path.open("rb") as file:
        header = file.read(HEADER)
    # Its version and byte order, four bytes of padding, and the variable with its tag.
    return loadmat(io.BytesIO(header + inner[:4] + inner[8 : 16 + size]))[nameless]


def _fields(value: Any) -> Iterator[Mapping[str, Any]]:
    """Yield every structure below a value, as its fields by name."""
    if not isinstance(value, np.ndarray):
        return
    if value.dtype.names:
        for each in value.ravel():
            fields = dict(zip(value.dtype.names, each, strict=True))
            yield fields
            for field in fields.values():
                yield from _fields(field)
    elif value.dtype == object:
        for each in value.ravel():
            yield from _fields(each)


def _learned(parameter: np.ndarray) -> Float[np.ndarray, "n m"]:
    return np.asarray(parameter["Value"][0, 0], np.float64)
