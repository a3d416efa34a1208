"""Functions of time as the client that simulators copy has them: against SciPy and the library."""

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from verifai_jax.addons.simulators.remote_client import Waveform as ClientWaveform
from verifai_jax.core.values.waveform import Waveform

UNEVEN = (0.0, 0.3, 1.0, 1.1, 2.0)


@pytest.mark.parametrize(("times", "count"), [(None, 5), (UNEVEN, 3), (None, 2), (UNEVEN, 5)])
def test_the_clients_pchip_is_that_of_scipy(times, count):
    rng = np.random.default_rng(count)
    where = np.linspace(0, 2, count) if times is None else np.asarray(times[:count])
    clock, times = np.linspace(-0.5, 2.5, 121), None if times is None else times[:count]
    for knots in (rng.normal(size=count), rng.integers(0, 2, count), rng.normal(size=(count, 2))):
        knots = np.asarray(knots, np.float32)
        oracle = PchipInterpolator(where, knots)(np.clip(clock, where[0], where[-1]))
        client = ClientWaveform(knots, "pchip", 2.0, times)
        np.testing.assert_allclose([client(float(t)) for t in clock], oracle, atol=1e-6)


@pytest.mark.parametrize(
    ("times", "width"), [(None, None), (None, 0.3), (UNEVEN, None), (UNEVEN, 0.08), ((0.5,), 0.7)]
)
def test_the_clients_pulses_are_those_of_the_library(times, width):
    knots = np.float32([1, -2, 0.5, 4, 4])[: None if times is None else len(times)]
    clock = np.linspace(-1, 3, 401).tolist()
    ours = Waveform(knots, "pulse", 2.0, times, width)
    client = ClientWaveform(knots, "pulse", 2.0, times, width)
    np.testing.assert_array_equal([client(t) for t in clock], [ours(t) for t in clock])
