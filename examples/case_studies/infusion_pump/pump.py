"""A pump for patient-controlled analgesia: a patient with a button, a monitor that stops it.

The drug goes from the blood (one compartment, first-order elimination) to where it acts (first
order, 20 min), and there it slows breathing. The pump gives a basal rate, and a bolus at a press
of the button if the lockout has passed. A monitor of the breathing, which lags, stops it for good.
"""

from pathlib import Path

import jax.numpy as jnp

import verifai_jax as vj

PERIOD = 30.0
"""Seconds between two decisions of the pump."""
BASAL, BOLUS, LOCKOUT = 1.0, 1.0, 600.0
"""Prescription: mg/h, mg, and seconds from one bolus to the next."""
RATE = BOLUS * 3600.0 / PERIOD
"""The rate in mg/h that gives a bolus in one period."""
ALARM = 10.0
"""Breaths a minute below which the monitor stops the pump."""
RESTING, HALF = 14.0, 0.09
"""Breaths a minute without the drug, and mg/l that halve them."""
LIMIT = 30.0
"""Four-hour limit in mg."""


def breaths(effect):
    """Return the breaths a minute at a concentration where the drug acts."""
    return RESTING / (1 + (effect / HALF) ** 2)


def start(features, key):
    zero = jnp.asarray(0.0)
    return {"blood": zero, "effect": zero, "given": zero}


def pump(time, state, memory, features):
    """Give a bolus where the patient asks for one and may have it, unless the monitor objects."""
    seen = memory["seen"] + PERIOD / features["lag"] * (breaths(state["effect"]) - memory["seen"])
    stopped = jnp.maximum(memory["stopped"], jnp.where(seen < ALARM, 1.0, 0.0))
    asked = time - memory["last"] >= jnp.maximum(features["press"], LOCKOUT)
    allowed = state["given"] + BOLUS <= LIMIT
    bolus = asked & allowed & (stopped < 0.5)
    rate = jnp.where((stopped < 0.5) & allowed, BASAL, 0.0) + jnp.where(bolus, RATE, 0.0)
    last = jnp.where(bolus, time, memory["last"])
    return {"rate": rate, "stopped": stopped}, {"seen": seen, "stopped": stopped, "last": last}


def patient(time, state, control, features):
    """Return the derivative per second of concentrations in mg/l, and of what was given in mg."""
    inflow = control["rate"] * (1 + features["flow_error"]) / 3600.0
    out = features["clearance"] / 3600.0 * state["blood"]
    return {
        "blood": (inflow - out) / features["volume"],
        "effect": (state["blood"] - state["effect"]) / 1200.0,
        "given": inflow,
    }


problem = vj.Problem(
    "pump",
    {
        "clearance": vj.LogUniform(15.0, 90.0),
        "volume": vj.Box(60.0, 200.0),
        "press": vj.Box(300.0, 3600.0),
        "lag": vj.Box(60.0, 900.0),
        "flow_error": vj.Box(-0.05, 0.05),
    },
    vj.ode(
        patient,
        start,
        controller=pump,
        controller_memory={"seen": RESTING, "stopped": 0.0, "last": -LOCKOUT},
        control_period=PERIOD,
        dt=PERIOD,
        duration=4 * 3600.0,
        signals=lambda time, state, control, features: {
            **state,
            **control,
            "breathing": breaths(state["effect"]),
        },
    ),
    {
        "PUMP-1": "always breathing >= 8",
        "PUMP-2": "always given <= 30",
        "PUMP-3": "always (stopped >= 0.5 -> always rate <= 0.001)",
        "PUMP-4": "eventually[0, 3600] always[0, 300] effect >= 0.005",
    },
    requirements=Path(__file__).with_name("requirements.yaml"),
    nominal={"clearance": 60.0, "volume": 120.0, "press": 1200.0, "lag": 120.0, "flow_error": 0.0},
    description="a pump for patient-controlled analgesia, for weak and strong patients",
)
