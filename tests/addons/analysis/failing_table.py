"""A table with a known cause of failure, for tests of several analyses."""

import numpy as np
import pandas as pd


def failing_table(n, seed=0):
    """Robustness x + 2 [colour is red], which fails below 0.3; y, lanes and same do nothing."""
    g = np.random.default_rng(seed)
    frame = pd.DataFrame(
        {
            "y": g.random(n),
            "x": g.random(n),
            "colour": g.choice(["red", "blue", "green"], n),
            "lanes": g.integers(0, 4, n),
            "same": 1.0,
        }
    )
    frame["rho"] = frame.x + 2 * (frame.colour == "red") - 0.3
    return frame.assign(violated=frame.rho < 0, status="ok")
