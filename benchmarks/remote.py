"""Simulations a second through `remote`, over loopback, with Python clients on the same machine.

    python benchmarks/remote.py [--clients 2] [--simulations 20000] [--samples 50]

Measured three ways: `simulate_each` alone, which is the server and the clients; a whole `falsify`
with search, monitor and table; and the same `falsify` with the function in this process, one by
one. Each is the median of five. A simulation is a few NumPy operations on two signals.
"""

import argparse
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

SAMPLES = int(os.environ.get("SAMPLES", "50"))
TIME = 0.02 * np.arange(SAMPLES)


def simulate(features, seed):
    """A damped oscillation; what the clients run."""
    angle = features["frequency"] * TIME
    size = np.exp(-features["damping"] * TIME)
    return {"x": size * np.cos(angle), "v": size * np.sin(angle), "dt": 0.02}


def main() -> None:
    """Measure, and print a line for each way."""
    import verifai_jax as vj
    from verifai_jax.addons.simulators import remote_client
    from verifai_jax.addons.simulators.remote import remote

    parser = argparse.ArgumentParser()
    parser.add_argument("--clients", type=int, default=2)
    parser.add_argument("--simulations", type=int, default=20_000)
    parser.add_argument("--samples", type=int, default=SAMPLES)
    given = parser.parse_args()
    space = {"frequency": vj.Box(1.0, 9.0), "damping": vj.Box(0.0, 1.0)}
    features = [{"frequency": 1.0 + i % 8, "damping": 0.1} for i in range(given.simulations)]

    def report(what: str, once) -> None:
        rates = []
        for _ in range(6):
            begun = time.perf_counter()
            once()
            rates.append(given.simulations / (time.perf_counter() - begun))
        # The first one compiles the monitor, and fills the clients' windows.
        print(f"{what}: {statistics.median(rates[1:]):,.0f} simulations/s", flush=True)

    def falsify(system):
        problem = vj.Problem("oscillation", space, system, "always abs(x) <= 0.99")
        return lambda: vj.falsify(problem, "uniform", given.simulations, progress=False)

    with remote(signals=("x", "v"), dt=0.02, length=given.samples) as system:
        address = "{}:{}".format(*system.address)
        command = [sys.executable, remote_client.__file__, "--address", address]
        command += ["--reconnect", "3", f"{Path(__file__)}:simulate"]
        environment = {**os.environ, "SAMPLES": str(given.samples), "OMP_NUM_THREADS": "1"}
        clients = [
            subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)
            for _ in range(given.clients)
        ]
        while len(system.clients) < given.clients:
            time.sleep(0.05)
        each = f"{given.clients} clients, {given.samples} samples of 2 signals"

        def alone() -> None:
            outcomes = system.simulate_each(features, [0] * len(features))
            assert sum(outcome.trace is not None for _, outcome in outcomes) == len(features)

        report(f"remote, simulate_each, {each}", alone)
        report(f"remote, falsify, {each}", falsify(system))
    for client in clients:
        client.wait()

    def here(features):
        result = simulate(features, 0)
        return vj.Trace({"x": result["x"], "v": result["v"]}, dt=result["dt"])

    report("in this process, falsify", falsify(vj.blackbox(here)))


if __name__ == "__main__":
    main()
