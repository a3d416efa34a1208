"""Properties of a network alone: `verify_network` proves, breaks or leaves them undecided."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import verifai_jax as vj
from verifai_jax.addons.verification._verify import verify
from verifai_jax.addons.verification.boxes import PROVED
from verifai_jax.addons.verification.vnnlib import Case, read_property
from verifai_jax.core.messages.checks import check_positive
from verifai_jax.core.store.atomic_files import replacing

SEARCHED = 4096
"""Simulations of the search for a counterexample."""
HOLDS, COUNTEREXAMPLE, UNKNOWN = "holds", "counterexample", "unknown"


@dataclass
class NetworkAnswer:
    """The answer about a property of a network: `holds`, `counterexample` or `unknown`.

    - `inputs`, `outputs`: a counterexample, whose outputs the network computes; None without one.
    - `proved`: the proved share of the inputs of the boxes, from 0 to 1.
    - `boxes`: for each box of the property, the corners of its proved parts, `[2, n, inputs]`, as
      shares of the box.
    """

    verdict: str
    inputs: Float[np.ndarray, " inputs"] | None
    outputs: Float[np.ndarray, " outputs"] | None
    proved: float
    boxes: list[Float[np.ndarray, "2 n inputs"]]

    def save(self, path: str | Path) -> Path:
        """Write the proved boxes as JSON, for another program to check."""
        whole = {"verdict": self.verdict, "proved": [each.tolist() for each in self.boxes]}
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(whole))
        return Path(path)


def verify_network(
    network: str | Path, rule: str | Path, budget: float = 60.0, *, boxes: int | None = None,
    seed: int = 0, precision: str = "float32", progress: bool | None = None,
) -> NetworkAnswer:  # fmt: skip
    """Prove a property in VNN-LIB of a network in ONNX, or find a counterexample.

    A proof holds in real arithmetic and with the rounding of `precision`. A search
    for a counterexample comes first, for each box of the property.

    **Arguments:**
    - `network`: the file of the network, one that `vj.policy` reads.
    - `rule`: the file of the property.
    - `budget`: approximate seconds for all boxes of the property.
    - `boxes`: maximum number of boxes to examine for each box of the property.
    - `seed`, `precision`, `progress`: as in `verify`.
    **Raises:** `ValueError` for a file that is no property, and for one with another number of
    inputs or outputs than the network.
    """
    check_positive("budget", budget)
    cases, act = read_property(Path(rule)), vj.policy(network).act
    parts, masses = list[np.ndarray](), list[float]()
    for number, case in enumerate(cases):
        low, high = (_rounded(end, side) for end, side in ((case.low, -1), (case.high, 1)))
        case = replace(case, low=low, high=high)
        varying = np.flatnonzero(low < high)
        problem = _problem(f"case {number + 1}", act, case, varying)
        once = vj.Stop(after=1)
        run = vj.falsify(problem, budget=SEARCHED, stop=once, seed=seed, progress=False)
        failing, found = run.table.counterexamples, None
        point = problem.space.from_row(dict(failing.iloc[0])) if len(failing) else None
        for share in (0.1, 0.9) if point is None else ():
            # A counterexample that the first boxes have ends the work.
            found = verify(
                problem, stop=vj.Stop(seconds=share * budget / len(cases)), boxes=boxes, samples=0,
                seed=seed, precision=precision, progress=progress, resume=found,
            )  # fmt: skip
            if found.boxes.confirmed.any() or found.proved.mass == 1.0:
                break
        if found is not None:
            low, high, proved = found.boxes.low, found.boxes.high, found.boxes.state == PROVED
            corners = np.zeros((2, int(proved.sum()), len(case.low)))
            corners[1] = 1.0
            if len(varying):
                corners[0][:, varying], corners[1][:, varying] = low[proved], high[proved]
            parts.append(corners)
            masses.append(float(found.proved.mass))
            sure = np.flatnonzero(found.boxes.confirmed & found.boxes.has_witness)
            if len(sure):
                point = problem.space.unflatten(jnp.float32(found.boxes.witness[sure[0]]))
        if point is not None:
            # The box is rounded outwards by a unit of single precision, but not the counterexample.
            exact = cases[number]
            inputs = np.asarray(_inputs(case, varying, point), float)
            inputs = np.clip(inputs, exact.low, exact.high)
            outputs = jnp.ravel(act(jnp.asarray(inputs, jnp.float32)))
            if float(exact.margin(jnp.asarray(inputs, jnp.float32), outputs)) <= 0:
                share = sum(masses) / len(cases)
                return NetworkAnswer(COUNTEREXAMPLE, inputs, np.asarray(outputs), share, parts)
            masses.append(0.0)
    share = sum(masses) / len(cases) if cases else 1.0
    verdict = HOLDS if all(mass == 1.0 for mass in masses) else UNKNOWN
    return NetworkAnswer(verdict, None, None, share, parts)


def _rounded(numbers: np.ndarray, side: int) -> np.ndarray:
    """Return numbers of single precision that are not less, or not greater, than these."""
    near = numbers.astype(np.float32)
    beyond = (near < numbers) if side > 0 else (near > numbers)
    return np.where(beyond, np.nextafter(near, np.float32(side * np.inf)), near).astype(float)


def _inputs(case: Case, varying: np.ndarray, features: Any) -> Any:
    """Return the inputs of the network, of which some do not vary."""
    fixed = jnp.asarray(case.low, jnp.result_type(features["x"]))
    return fixed.at[varying].set(features["x"]) if len(varying) else fixed + 0 * features["x"][0]


def _problem(name: str, act: Any, case: Case, varying: np.ndarray) -> vj.Problem:
    """Return the problem whose failures are the counterexamples in a box."""

    def system(features: Any, key: Any) -> vj.Trace:
        inputs = _inputs(case, varying, features)
        outputs = jnp.ravel(act(inputs))
        return vj.Trace({"margin": case.margin(inputs, outputs)[None]}, dt=1.0)

    low, high = (end[varying] if len(varying) else end[:1] for end in (case.low, case.high))
    if not len(varying):
        low, high = np.zeros(1), np.ones(1)
    return vj.Problem(name, {"x": vj.Box(low.tolist(), high.tolist())}, system, "margin > 0")
