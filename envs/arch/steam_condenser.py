"""SC: a steam condenser whose cooling is driven by a recurrent neural network.

    steam_condenser()                                   # 35 s; feature steam
    steam_condenser()({"steam": 4.0})

Feature, a function of time or a number: `steam`, the flow into the condenser, 3.99 to 4.01 kg/s.
Signals, every 0.01 s: `P`, the pressure that the sensor reads (kPa); `T`, the outlet temperature
of the cooling water (C); `F`, its flow (kg/s); `Q`, the heat that it takes (kW).

Source: the public Simulink model steamcondense_RNN_22.slx, its tables and weights. Its solver has a
variable step; here it is the classical Runge-Kutta method with 0.01 s, whose results agree with
those of a tenth of the step to 1e-6 kPa.
"""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import verifai_jax as vj
from envs.arch.stepped import value
from verifai_jax.systems.ode import Ode

DT = 0.01
NOMINAL = {"steam": 4.0}
PRESSURES = (50.0, 60.0, 70.0, 80.0, 90.0, 100.0, 110.0)
CONDENSATION = vj.blocks.LookupTable(
    PRESSURES,
    (81.3167, 85.9258, 89.9315, 93.4854, 96.6870, 99.6059, 102.2923),
    beyond="extrapolate",
)
"""Temperature of condensing steam in C, by its pressure in kPa."""
LATENT_HEAT = vj.blocks.LookupTable(
    PRESSURES,
    (2305.42, 2293.64, 2283.30, 2274.05, 2265.65, 2257.92, 2250.76),
    beyond="extrapolate",
)
"""Heat of vaporisation in kJ/kg, by the pressure in kPa."""
INLET = 60.0
GAS = 0.461526
FLOW = 107.8880952381
SETPOINTS = (90.0, 87.0)
SWITCHED_AT = 2.0
# Of the controller's network: what scales its input and output, and its weights.
INPUT_LOW, INPUT_SPAN = -3.7742393716738434, 9.5739824941763819
OUTPUT_LOW, OUTPUT_HIGH = -30.855068745036114, 66.879264965962932
IW = np.array([-0.36932254958803395, 0.37111199431650393, -0.52736280584118833])
LW = np.array(
    [
        [
            *(0.44769854454577174, 1.1961840315574388, 1.1412233787458486),
            *(0.72001623019786209, -0.37547125154051064, -0.61546760904874331),
        ],
        [
            *(-0.16668730359454359, -0.016432941671533533, -0.22132796342367161),
            *(-0.037206224095552992, 0.059874671921603305, 0.080202592729115826),
        ],
        [
            *(0.24187644262601646, -0.66963285238228187, -1.0984401489322673),
            *(0.029109804692608397, 1.3722216833345802, 0.66166906669524039),
        ],
    ]
)
B1 = np.array([0.40129050296348601, -0.12475735064274925, -1.3584541012442735])
LW2 = np.array([-0.22749313555095124, 2.0804967759906643, -0.56644809886208158])
B2 = -0.33227866684137108

Features = Mapping[str, Any]
State = dict[str, Float[Array, "..."]]


def initial(features: Features, key: Any) -> dict[str, Any]:
    """Return the state at time 0: the plant, the sensor, the setpoint, lags of the network."""
    plant = {"P": 90.0, "T": 80.0, "F": FLOW}
    return {**plant, "sensor": 90.0, "setpoint": SETPOINTS[0], "lags": jnp.zeros(6)}


def update(time: Any, state: State, features: Features) -> dict[str, Any]:
    """Return the state with the setpoint of this sample on; it would jump within a step."""
    after = time >= SWITCHED_AT - DT / 2
    return {**state, "setpoint": jnp.where(after, SETPOINTS[1], SETPOINTS[0])}


def heat(state: State) -> Float[Array, ""]:
    """Return the heat in kW that the cooling water takes from the steam."""
    condensing = CONDENSATION(state["P"])
    ratio = (condensing - INLET) / (condensing - state["T"])
    mean_difference = (state["T"] - INLET) / jnp.log(ratio)
    return mean_difference / (0.0872924756541668 / state["F"] ** 0.8 + 0.00073786772008033)


def network(error: Float[Array, ""], lags: Float[Array, "6"]) -> tuple[Any, Any]:
    """Return the output of the controller and the derivative of its lags."""
    scaled = (error - INPUT_LOW) * 2 / INPUT_SPAN - 1
    hidden = jnp.tanh(scaled * IW + LW @ lags + B1)
    output = (LW2 @ hidden + B2 + 1) * (OUTPUT_HIGH - OUTPUT_LOW) / 2 + OUTPUT_LOW
    return output, jnp.concatenate([hidden, lags[:3]]) - 10 * lags


def dynamics(time: Any, state: State, control: None, features: Features) -> dict[str, Any]:
    """Return the derivative of the state."""
    pressure, temperature, flow = state["P"], state["T"], state["F"]
    taken = heat(state)
    condensed = taken / LATENT_HEAT(pressure)
    output, lags = network(state["sensor"] - state["setpoint"], state["lags"])
    steam = value(features["steam"], time)
    return {
        "P": (steam - condensed) * CONDENSATION(pressure) * GAS / 3,
        "T": (taken / 4.2 + (INLET - temperature) * flow) / 500,
        "sensor": (pressure - state["sensor"]) / 0.5,
        "F": jnp.clip(output + FLOW, 0, 200) - flow,
        "setpoint": jnp.zeros_like(flow),
        "lags": lags,
    }


def signals(time: Any, state: State, control: None, features: Features) -> dict[str, Any]:
    """Return the signals of the requirement."""
    return {"P": state["sensor"], "T": state["T"], "F": state["F"], "Q": heat(state)}


def steam_condenser(duration: float = 35.0) -> Ode:
    """Make the model a system.

    - `duration`: simulated seconds, a multiple of 0.01.
    """
    return vj.ode(dynamics, initial, dt=DT, duration=duration, signals=signals, update=update)
