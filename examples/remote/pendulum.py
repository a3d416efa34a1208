"""The same simulator in Python: `python examples/remote/pendulum.py [PORT]`."""

import sys

import numpy as np

from verifai_jax.addons.simulators.remote_client import serve

DT, SAMPLES = 0.02, 200


def simulate(features, seed):
    """A damped pendulum, let go at `theta0` (rad); `length` in m."""
    theta, omega = np.empty(SAMPLES), np.empty(SAMPLES)
    angle, rate = features["theta0"], 0.0
    for k in range(SAMPLES):
        theta[k], omega[k] = angle, rate
        rate += DT * (-9.81 / features["length"] * np.sin(angle) - 0.1 * rate)
        angle += DT * rate
    return {"theta": theta, "omega": omega, "dt": DT}


if __name__ == "__main__":
    serve(simulate, port=int(sys.argv[1]) if len(sys.argv) > 1 else 4567)
