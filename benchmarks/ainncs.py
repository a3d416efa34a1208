"""The problems of ARCH-COMP's AINNCS category with their own networks, which a folder contains.

    python benchmarks/ainncs.py FOLDER                        # all, a minute each
    python benchmarks/ainncs.py FOLDER tora unicycle --seconds 300

Equations, initial sets and properties are those of the category (D. Manzanas Lopez et al.,
ARCH-COMP Category Report: Artificial Intelligence and Neural Network Control Systems, 2020 to
2026). The networks have no licence, so they are read from a folder: `acc.onnx`, `tora.onnx`,
`tora_relu_tanh.txt` and so on. Plants are verified as differential equations at all times, with the
controller's output held for its period; the collision avoidance system is a map.

Each problem is searched for a counterexample first, for a second. Without one its boxes are proved.
What is printed: `falsified`, with the least robustness of a counterexample that replays confirm;
`verified`; or `bounded`, with the bounds of the failure probability under a uniform prior.
"""

import argparse
import itertools
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import verifai_jax as vj

SECONDS = 60.0
Ends = dict[str, tuple[float, float]]


class Answer(NamedTuple):
    """What is known of a problem: `verified`, `falsified` or `bounded`, and the numbers for it.

    - `low`, `high`: bounds of the failure probability under a uniform prior.
    - `robustness`: the least of a confirmed counterexample; NaN without one.
    """

    verdict: str
    low: float
    high: float
    robustness: float
    seconds: float


def from_onnx(path: Path) -> Callable[[jax.Array], jax.Array]:
    """Return a network, also of operator set 6, whose additions are those of set 7 here."""
    import onnx

    model = onnx.load(path)
    if model.opset_import[0].version >= 7:
        return vj.policy(path).act
    for node in model.graph.node:
        kept = [each for each in node.attribute if each.name not in ("broadcast", "axis")]
        del node.attribute[:]
        node.attribute.extend(kept)
    model.opset_import[0].version = 7
    with tempfile.TemporaryDirectory() as folder:
        onnx.save(model, Path(folder) / "network.onnx")
        return vj.policy(Path(folder) / "network.onnx").act


def from_text(path: Path, hidden: Callable, last: Callable) -> Callable[[jax.Array], jax.Array]:
    """Return a network of Sherlock's format: counts, then weights and a bias of each unit."""
    numbers = iter(path.read_text().split())
    inputs, outputs, layers = (int(next(numbers)) for _ in range(3))
    sizes = [inputs, *(int(next(numbers)) for _ in range(layers)), outputs]
    weights = []
    for n, m in itertools.pairwise(sizes):
        rows = np.array([[float(next(numbers)) for _ in range(n + 1)] for _ in range(m)])
        weights.append((np.float32(rows[:, :-1].T), np.float32(rows[:, -1])))
    offset, scale = (float(next(numbers)) for _ in range(2))

    def network(x: jax.Array) -> jax.Array:
        for matrix, shift in weights[:-1]:
            x = hidden(x @ matrix + shift)
        x = last(x @ weights[-1][0] + weights[-1][1])
        return (x - offset) * scale

    return vj.policy(network).act


def held(
    name: str, rates: Callable, control: Callable, start: Ends, seconds: float, period: float,
    spec: str, *, parts: int = 1, features: Ends | None = None, signals: Callable | None = None,
) -> vj.Problem:  # fmt: skip
    """Return a plant whose controller's output is held for a period.

    **Arguments:**
    - `rates`: from states, controls and features to the derivatives of the states, all as lists.
    - `control`: a network of the states.
    - `start`: the initial ends of each state, in order; a state that is a single number is no
      feature.
    - `parts`: steps of the integration in a period.
    """
    names = [*start]

    def initial(f: Any, key: Any) -> tuple:
        like = 0.0 * next(iter(f.values()))
        return tuple(f[n] if n in f else like + start[n][0] for n in names)

    def named(t: Any, s: Any, u: Any, f: Any) -> dict[str, Any]:
        more = signals(*s) if signals else {}
        return dict(zip(names, s, strict=True)) | more

    space = {n: ends for n, ends in start.items() if ends[0] < ends[1]} | (features or {})
    system = vj.ode(
        lambda t, s, u, f: tuple(rates(s, u, f)), initial, dt=period / parts, duration=seconds,
        controller=lambda t, s, f: control(jnp.stack(s)), control_period=period, signals=named,
    )  # fmt: skip
    return vj.Problem(name, {n: vj.Box(*ends) for n, ends in space.items()}, system, spec)


def acc(folder: Path) -> vj.Problem:
    """Adaptive cruise control behind a car that brakes: the distance stays safe."""
    network = from_onnx(folder / "acc.onnx")

    def rates(s, u, f):
        return (
            s[1], s[2], -2 * s[2] - 4.0 - 1e-4 * s[1] ** 2,
            s[4], s[5], -2 * s[5] + 2 * u[0] - 1e-4 * s[4] ** 2,
        )  # fmt: skip

    def control(s):
        return network(jnp.stack([30.0 + 0 * s[0], 1.4 + 0 * s[0], s[4], s[0] - s[3], s[1] - s[4]]))

    start = {
        "x_lead": (90.0, 110.0), "v_lead": (32.0, 32.2), "g_lead": (0.0, 0.0),
        "x_ego": (10.0, 11.0), "v_ego": (30.0, 30.2), "g_ego": (0.0, 0.0),
    }  # fmt: skip
    return held("acc", rates, control, start, 5.0, 0.1, "always x_lead - x_ego - 1.4 * v_ego >= 10")


def _tora(name: str, control: Callable, start: list, seconds: float, period: float, spec: str):
    def rates(s, u, f):
        return s[1], -s[0] + 0.1 * jnp.sin(s[2]), s[3], u[0]

    ends = dict(zip(("x1", "x2", "x3", "x4"), start, strict=True))
    return held(name, rates, control, ends, seconds, period, spec, parts=int(4 * period))


def tora(folder: Path) -> vj.Problem:
    """Translational oscillator, ReLU: all states stay in a box."""
    network = from_onnx(folder / "tora.onnx")
    parts = " & ".join(f"abs(x{i}) <= 2" for i in range(1, 5))
    start = [(0.6, 0.7), (-0.7, -0.6), (-0.4, -0.3), (0.5, 0.6)]
    return _tora("tora", lambda s: network(s) - 10, start, 20.0, 1.0, f"always ({parts})")


TORA_GOAL = "eventually (x1 >= -0.1 & x1 <= 0.2 & x2 >= -0.9 & x2 <= -0.6)"
TORA_START = [(-0.77, -0.75), (-0.45, -0.43), (0.51, 0.54), (-0.3, -0.28)]


def tora_relu_tanh(folder: Path) -> vj.Problem:
    """Translational oscillator, ReLU and tanh: it reaches a box."""
    network = from_text(folder / "tora_relu_tanh.txt", jax.nn.relu, jnp.tanh)
    return _tora("tora_relu_tanh", network, TORA_START, 5.0, 0.5, TORA_GOAL)


def tora_sigmoid(folder: Path) -> vj.Problem:
    """Translational oscillator, sigmoid: it reaches a box."""
    network = from_text(folder / "tora_sigmoid.txt", jax.nn.sigmoid, jax.nn.sigmoid)
    return _tora("tora_sigmoid", network, TORA_START, 5.0, 0.5, TORA_GOAL)


def unicycle(folder: Path) -> vj.Problem:
    """Unicycle with a disturbance: it reaches a box around the origin."""
    network = from_onnx(folder / "unicycle.onnx")

    def rates(s, u, f):
        return s[3] * jnp.cos(s[2]), s[3] * jnp.sin(s[2]), u[1], u[0] + f["w"]

    start = {"x": (9.5, 9.55), "y": (-4.5, -4.45), "angle": (2.1, 2.11), "v": (1.5, 1.51)}
    goal = "abs(x) <= 0.6 & abs(y) <= 0.2 & abs(angle) <= 0.06 & abs(v) <= 0.3"
    return held(
        "unicycle", rates, lambda s: network(s) - 20, start, 10.0, 0.2, f"eventually ({goal})",
        features={"w": (-1e-4, 1e-4)},
    )  # fmt: skip


def single_pendulum(folder: Path) -> vj.Problem:
    """Single pendulum: the angle is in [0, 1] from half a second on."""
    network = from_onnx(folder / "single_pendulum.onnx")

    def rates(s, u, f):
        return s[1], 2 * jnp.sin(s[0]) + 8 * u[0]

    start = {"angle": (1.0, 1.2), "speed": (0.0, 0.2)}
    spec = "always[0.5, 1] (angle >= 0 & angle <= 1)"
    return held("single_pendulum", rates, network, start, 1.0, 0.05, spec)


def single_pendulum_less(folder: Path) -> vj.Problem:
    """Single pendulum from the smaller initial set, for which the property holds."""
    problem = single_pendulum(folder)
    space = {"angle": vj.Box(1.0, 1.175), "speed": vj.Box(0.0, 0.2)}
    return vj.Problem("single_pendulum_less", space, problem.system, problem.formulas)


def _double_pendulum(name: str, network: Callable, period: float, spec: str) -> vj.Problem:
    def rates(s, u, f):
        a, b, v, w = s
        gap = a - b
        common = 4 * u[0] + 2 * jnp.sin(a) - w * w * jnp.sin(gap) / 2
        below = jnp.cos(gap) ** 2 / 2 - 1
        numerator = v * v * jnp.sin(gap) + 8 * u[1] + 2 * jnp.sin(b) - jnp.cos(gap) * common
        return v, w, common + jnp.cos(gap) * numerator / (2 * below), -numerator / below

    start = dict.fromkeys(("angle1", "angle2", "speed1", "speed2"), (1.0, 1.3))
    return held(name, rates, network, start, 20 * period, period, spec)


def double_pendulum_less(folder: Path) -> vj.Problem:
    """Double pendulum with the less robust network: all states stay in a box."""
    parts = " & ".join(f"{n} >= -1 & {n} <= 1.7" for n in ("angle1", "angle2", "speed1", "speed2"))
    network = from_onnx(folder / "double_pendulum_less.onnx")
    return _double_pendulum("double_pendulum_less", network, 0.05, f"always ({parts})")


def double_pendulum_more(folder: Path) -> vj.Problem:
    """Double pendulum with the more robust network: all states stay in a smaller box."""
    names = ("angle1", "angle2", "speed1", "speed2")
    parts = " & ".join(f"{n} >= -0.5 & {n} <= 1.5" for n in names)
    network = from_onnx(folder / "double_pendulum_more.onnx")
    return _double_pendulum("double_pendulum_more", network, 0.02, f"always ({parts})")


def airplane(folder: Path) -> vj.Problem:
    """Airplane of unit mass and inertia: position and angles stay bounded."""
    network = from_onnx(folder / "airplane.onnx")

    def rates(s, force, f):
        _, _, _, u, v, w, phi, theta, psi, r, p, q = s
        sines, cosines = ([each(a) for a in (phi, theta, psi)] for each in (jnp.sin, jnp.cos))
        (sp, st, sy), (cp, ct, cy) = sines, cosines
        tangent = st / ct
        return (
            cy * ct * u + (-sy * cp + cy * st * sp) * v + (sy * sp + cy * st * cp) * w,
            sy * ct * u + (cy * cp + sy * st * sp) * v + (-cy * sp + sy * st * cp) * w,
            -st * u + ct * sp * v + ct * cp * w,
            -st + force[0] - q * w + r * v,
            ct * sp + force[1] - r * u + p * w,
            ct * cp + force[2] - p * v + q * u,
            p + tangent * (sp * q + cp * r), cp * q - sp * r, (sp * q + cp * r) / ct,
            force[5], force[3], force[4],
        )  # fmt: skip

    names = ("x", "y", "z", "u", "v", "w", "phi", "theta", "psi", "r", "p", "q")
    start = {n: (0.0, 1.0) if 3 <= i < 9 else (0.0, 0.0) for i, n in enumerate(names)}
    parts = "abs(y) <= 0.5 & abs(phi) <= 1 & abs(theta) <= 1 & abs(psi) <= 1"
    return held("airplane", rates, network, start, 2.0, 0.1, f"always ({parts})")


def attitude(folder: Path) -> vj.Problem:
    """Attitude of a rigid body: it never enters a box."""
    network = from_onnx(folder / "attitude.onnx")

    def rates(s, u, f):
        a, b, c, x, y, z = s
        n = x * x + y * y + z * z
        return (
            (u[0] + b * c) / 4, (u[1] - 3 * a * c) / 2, u[2] + 2 * a * b,
            (b * (n - z) + c * (n + y) + a * (n + 1)) / 2,
            (a * (n + z) + c * (n - x) + b * (n + 1)) / 2,
            (a * (n - y) + b * (n + x) + c * (n + 1)) / 2,
        )  # fmt: skip

    start = {
        "w1": (-0.45, -0.44), "w2": (-0.55, -0.54), "w3": (0.65, 0.66),
        "p1": (-0.75, -0.74), "p2": (0.85, 0.86), "p3": (-0.65, -0.64),
    }  # fmt: skip
    unsafe = (
        "w1 >= -0.2 & w1 <= 0 & w2 >= -0.5 & w2 <= -0.4 & w3 >= 0 & w3 <= 0.2 & "
        "p1 >= -0.7 & p1 <= -0.6 & p2 >= 0.7 & p2 <= 0.8 & p3 >= -0.4 & p3 <= -0.2"
    )
    return held("attitude", rates, network, start, 3.0, 0.1, f"always not ({unsafe})")


def quadrotor(folder: Path, half: float = 0.4) -> vj.Problem:
    """Quadrotor: after five seconds it hovers at the height of one metre."""
    network = from_onnx(folder / "quadrotor.onnx")
    g, m, jx, jy, jz = 9.81, 1.4, 0.054, 0.054, 0.104

    def rates(s, u, f):
        _, _, _, a, b, c, phi, theta, psi, p, q, r = s
        sp, st, sy = jnp.sin(phi), jnp.sin(theta), jnp.sin(psi)
        cp, ct, cy = jnp.cos(phi), jnp.cos(theta), jnp.cos(psi)
        return (
            ct * cy * a + (sp * st * cy - cp * sy) * b + (cp * st * cy + sp * sy) * c,
            ct * sy * a + (sp * st * sy + cp * cy) * b + (cp * st * sy - sp * cy) * c,
            st * a - sp * ct * b - cp * ct * c,
            r * b - q * c - g * st, p * c - r * a + g * ct * sp,
            q * a - p * b + g * ct * cp - g - u[0] / m,
            p + (sp * q + cp * r) * st / ct, cp * q - sp * r, (sp * q + cp * r) / ct,
            (jy - jz) / jx * q * r + u[1] / jx, (jz - jx) / jy * p * r + u[2] / jy,
            (jx - jy) / jz * p * q,
        )  # fmt: skip

    start = {f"x{i}": (-half, half) if i <= 6 else (0.0, 0.0) for i in range(1, 13)}
    spec = "always[5, 5] (x3 >= 0.94 & x3 <= 1.06)"
    return held("quadrotor", rates, network, start, 5.0, 0.1, spec)


def quadrotor_part(folder: Path) -> vj.Problem:
    """Three tenths of the quadrotor's initial set in each of its coordinates."""
    return quadrotor(folder, 0.12)


def docking(folder: Path) -> vj.Problem:
    """Spacecraft docking: the speed stays below a limit that falls with the distance."""
    network, n = from_onnx(folder / "docking.onnx"), 0.001027

    def rates(s, u, f):
        return (
            s[2], s[3], 2 * n * s[3] + 3 * n * n * s[0] + u[0] / 12, -2 * n * s[2] + u[1] / 12
        )  # fmt: skip

    def signals(x, y, v, w):
        return {"room": 0.2 + 2 * n * jnp.sqrt(x * x + y * y) - jnp.sqrt(v * v + w * w + 1e-30)}

    start = {"x": (70.0, 106.0), "y": (70.0, 106.0), "v": (-0.28, 0.28), "w": (-0.28, 0.28)}
    return held("docking", rates, network, start, 40.0, 1.0, "always room >= 0", signals=signals)


G = 32.2
COMPLIES = (
    lambda h: True | (h > 0), lambda h: h <= 0, lambda h: h >= 0, lambda h: h <= -1500,
    lambda h: h >= 1500, lambda h: h <= -1500, lambda h: h >= 1500, lambda h: h <= -2500,
    lambda h: h >= 2500,
)  # fmt: skip
MIDDLE = (0, -7 * G / 24, 7 * G / 24, -7 * G / 24, 7 * G / 24, -G / 3, G / 3, -G / 3, G / 3)
"""Accelerations that pilots choose, by advisory."""


def _vcas(folder: Path, climb: float) -> vj.Problem:
    networks = [from_onnx(folder / f"vcas_{i}.onnx") for i in range(1, 10)]

    def advance(state, _):
        h, rate, left, last = state
        seen = jnp.stack([h, rate, left - 20.0]) / jnp.array([16000.0, 5000.0, 40.0])
        advice = jax.lax.switch(
            last, [lambda x, act=act: jnp.argmax(act(x)).astype(jnp.int32) for act in networks],
            seen,
        )  # fmt: skip
        complies = jnp.stack([jnp.asarray(each(60 * rate)) for each in COMPLIES])[advice]
        push = jnp.where((advice == last) & complies, 0.0, jnp.array(MIDDLE, jnp.float32)[advice])
        after = (h - rate - push / 2, rate + push, left - 1.0, advice)
        return after, after[0]

    def system(f, key):
        zero = 0.0 * f["h"]
        begin = (f["h"], zero + climb, zero + 25.0, jnp.int32(0))
        _, heights = jax.lax.scan(advance, begin, None, length=10)
        return vj.Trace({"h": jnp.concatenate([f["h"][None], heights])}, dt=1.0)

    name = f"vcas_{str(-climb).replace('.', '_')}"
    return vj.Problem(name, {"h": vj.Box(-133.0, -129.0)}, system, "always abs(h) > 100")


PROBLEMS: dict[str, Callable[[Path], vj.Problem]] = {
    each.__name__: each for each in (
        acc, tora, tora_relu_tanh, tora_sigmoid, unicycle, single_pendulum, single_pendulum_less,
        double_pendulum_less, double_pendulum_more, airplane, attitude, quadrotor, quadrotor_part,
        docking,
    )
} | {
    f"vcas_{str(-climb).replace('.', '_')}": lambda folder, climb=climb: _vcas(folder, climb)
    for climb in (-19.5, -22.5, -25.5, -28.5)
}  # fmt: skip
"""Problems of a folder with networks, by their names."""


def answer(problem: vj.Problem, seconds: float = SECONDS, boxes: int | None = None) -> Answer:
    """Falsify a problem for ten seconds, which include compilation, or prove it."""
    started = time.perf_counter()
    run = vj.falsify(problem, stop=vj.Stop(after=1, seconds=10.0), progress=False)
    if len(run.table.counterexamples):
        lowest = float(run.best["rho"])
        return Answer("falsified", 0.0, 1.0, lowest, time.perf_counter() - started)
    smooth = not problem.name.startswith("vcas")
    found = vj.verify(
        problem, stop=vj.Stop(seconds=seconds), boxes=boxes, continuous=smooth, progress=False
    )
    low, high = found.probability
    verdict = "verified" if high == 0 else "falsified" if low > 0 else "bounded"
    return Answer(verdict, low, high, float("nan"), time.perf_counter() - started)


def main() -> None:
    """Answer the problems, and print a row of a table for each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", default=[*PROBLEMS])
    parser.add_argument("--seconds", type=float, default=SECONDS)
    options = parser.parse_args()
    if unknown := {*options.names} - {*PROBLEMS}:
        parser.error(f"unknown problems {sorted(unknown)}; there are {', '.join(PROBLEMS)}")
    print("| problem | answer | failing, at least | at most | robustness | seconds | processor's |")
    print("|---|---|---|---|---|---|---|")
    for name in options.names:
        begun = time.process_time()
        found = answer(PROBLEMS[name](options.folder), options.seconds)
        print(f"| {name} | {found.verdict} | {found.low:.4g} | {found.high:.4g} | "
              f"{found.robustness:.4g} | {found.seconds:.1f} | {time.process_time() - begun:.1f} |",
              flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
