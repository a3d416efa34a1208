"""Loops with neural networks, proved box by box: the AINNCS problems of ARCH-COMP.

    python benchmarks/verify.py                         # all, ten minutes each
    python benchmarks/verify.py tora --seconds 60 --check 10000000

Equations, initial sets and properties are those of the AINNCS category of ARCH-COMP (D. Manzanas
Lopez et al., ARCH-COMP23 Category Report: Artificial Intelligence and Neural Network Control
Systems). The networks are ours: random features with output weights that fit a control law, which
is quick and the same everywhere. A threshold is as tight as samples allow, but for a tenth of the
margin that the specification leaves. Reported are the shares that are decided: proved, and boxes
in which every point fails; and whether uniform samples contradict a proof.
"""

import argparse
import time
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

import verifai_jax as vj
from verifai_jax.evaluation.evaluator import Evaluator

MARGIN = 0.1


def network(law: Callable, low: list[float], high: list[float], units: int, kind: str = "tanh"):
    """Fit a network of one hidden layer to a control law over a box of observations."""
    random = np.random.default_rng(0)
    low, high = np.array(low), np.array(high)
    middle, half = (low + high) / 2, (high - low) / 2
    inner = random.normal(size=(len(low), units)) / np.sqrt(len(low))
    shift = random.uniform(-1, 1, units)
    points = random.uniform(-1, 1, (4000, len(low)))
    act = np.tanh if kind == "tanh" else lambda x: np.maximum(x, 0)
    hidden = np.concatenate([act(points @ inner + shift), np.ones((len(points), 1))], axis=1)
    wanted = np.array([law(*point) for point in middle + half * points])
    ridge = 1e-3 * len(points) * np.eye(units + 1)
    outer = np.linalg.solve(hidden.T @ hidden + ridge, hidden.T @ wanted)
    inner = np.float32(inner / half[:, None])
    shift = np.float32(shift - middle @ inner)
    outer, offset = np.float32(outer[:-1]), np.float32(outer[-1])
    active = jnp.tanh if kind == "tanh" else lambda x: jnp.maximum(x, 0)

    def control(*state):
        return active(jnp.stack(state) @ inner + shift) @ outer + offset

    return control


def pendulum():
    """Single pendulum: the angle is in [0, 1] from half a second on."""
    control = network(lambda a, w: -6.0 * a - 2.5 * w, [-1, -3], [1.5, 2], 16, "relu")

    def dynamics(t, s, u, f):
        return {"a": s["w"], "w": (0.25 * jnp.sin(s["a"]) + u) / 0.125 * 0.1}

    def problem(threshold):
        system = vj.ode(
            dynamics, lambda f, key: {"a": f["a"], "w": f["w"]}, dt=0.05, duration=1.0,
            controller=lambda t, s, f: control(s["a"], s["w"]),
        )  # fmt: skip
        return vj.Problem(
            "pendulum", {"a": vj.Box(1.0, 1.2), "w": vj.Box(0.0, 0.2)}, system,
            f"always[0.5, 1] a <= {threshold!r}",
        )  # fmt: skip

    return problem, 2.0, -1.0


def double_integrator():
    """Double integrator: within five steps position and speed are small."""
    control = network(lambda x, v: -0.4 * x - 1.2 * v, [-1, -2], [4, 2], 10, "relu")

    def dynamics(t, s, u, f):
        return {"x": s["v"], "v": u}

    def problem(threshold):
        system = vj.ode(
            dynamics, lambda f, key: {"x": f["x"], "v": f["v"]}, dt=0.5, duration=5.0,
            controller=lambda t, s, f: control(s["x"], s["v"]), control_period=1.0,
        )  # fmt: skip
        return vj.Problem(
            "double integrator", {"x": vj.Box(2.5, 3.0), "v": vj.Box(-0.25, 0.25)}, system,
            f"always[3, 5] (abs(x) <= {threshold!r} & abs(v) <= 1.0)",
        )  # fmt: skip

    return problem, 2.0, -1.0


def tora():
    """TORA with a controller that holds its action for a second: all states stay in a box."""
    control = network(lambda a, b, c, d: 0.5 * b - 0.6 * c - 0.9 * d, [-2] * 4, [2] * 4, 20)

    def dynamics(t, s, u, f):
        a, b, c, d = s
        return b, -a + 0.1 * jnp.sin(c), d, u

    def problem(threshold):
        system = vj.ode(
            dynamics, lambda f, key: (f["a"], f["b"], f["c"], f["d"]), dt=0.1, duration=20.0,
            controller=lambda t, s, f: control(*s), control_period=1.0,
            signals=lambda t, s, u, f: dict(zip("abcd", s, strict=True)),
        )  # fmt: skip
        space = {"a": vj.Box(0.6, 0.7), "b": vj.Box(-0.7, -0.6), "c": vj.Box(-0.4, -0.3),
                 "d": vj.Box(0.5, 0.6)}  # fmt: skip
        parts = " & ".join(f"abs({name}) <= {threshold!r}" for name in "abcd")
        return vj.Problem("TORA", space, system, f"always[0, 20] ({parts})")

    return problem, 2.0, -1.0


def van_der_pol():
    """Van der Pol's oscillator with a network: it comes to rest."""
    control = network(lambda x, v: -1.2 * x - 2.6 * v, [-2, -2], [2, 2], 16)

    def dynamics(t, s, u, f):
        return {"x": s["v"], "v": (1 - s["x"] ** 2) * s["v"] - s["x"] + u}

    def problem(threshold):
        system = vj.ode(
            dynamics, lambda f, key: {"x": f["x"], "v": f["v"]}, dt=0.05, duration=6.0,
            controller=lambda t, s, f: control(s["x"], s["v"]), control_period=0.1,
        )  # fmt: skip
        return vj.Problem(
            "Van der Pol", {"x": vj.Box(-0.5, 0.5), "v": vj.Box(-0.5, 0.5)}, system,
            f"always[4, 6] abs(x) <= {threshold!r}",
        )  # fmt: skip

    return problem, 1.0, -1.0


def cruise():
    """Adaptive cruise control behind a car that brakes: the distance stays safe."""
    control = network(
        lambda v, gap, rate: jnp.clip(0.25 * (gap - 10 - 1.4 * v) + 0.6 * rate, -3, 2).item(),
        [20, 20, -8], [35, 110, 8], 20,
    )  # fmt: skip

    def dynamics(t, s, u, f):
        drag = 1e-4
        return {
            "x_lead": s["v_lead"], "v_lead": s["g_lead"],
            "g_lead": -2 * s["g_lead"] + 2 * -2.0 - drag * s["v_lead"] ** 2,
            "x_ego": s["v_ego"], "v_ego": s["g_ego"],
            "g_ego": -2 * s["g_ego"] + 2 * u - drag * s["v_ego"] ** 2,
        }  # fmt: skip

    def problem(threshold):
        def initial(f, key):
            zero = 0 * f["v_ego"]
            return {"x_lead": f["x_lead"], "v_lead": f["v_lead"], "g_lead": zero,
                    "x_ego": f["x_ego"], "v_ego": f["v_ego"], "g_ego": zero}  # fmt: skip

        system = vj.ode(
            dynamics, initial, dt=0.1, duration=5.0,
            controller=lambda t, s, f: control(
                s["v_ego"], s["x_lead"] - s["x_ego"], s["v_lead"] - s["v_ego"]
            ),
        )  # fmt: skip
        space = {"x_lead": vj.Box(90.0, 110.0), "v_lead": vj.Box(32.0, 32.2),
                 "x_ego": vj.Box(10.0, 11.0), "v_ego": vj.Box(30.0, 30.2)}  # fmt: skip
        return vj.Problem(
            "ACC", space, system, f"always (x_lead - x_ego - 1.4 * v_ego >= {threshold!r})"
        )

    return problem, 10.0, 1.0


def quadrotor():
    """Quadrotor: it rises by a metre, and stays there after four seconds."""
    gravity, mass, inertia = 9.81, 1.4, (0.054, 0.054, 0.104)
    control = network(
        lambda height, ahead, aside, down, roll, pitch, p, q: (
            -4.0 * (height - 1) + 4.5 * down, -0.5 * roll - 0.3 * p - 0.05 * aside,
            -0.5 * pitch - 0.3 * q + 0.05 * ahead,
        ),
        [-0.5] + [-1] * 3 + [-0.2] * 2 + [-0.4] * 2, [1.5] + [1] * 3 + [0.2] * 2 + [0.4] * 2, 48,
    )  # fmt: skip

    def dynamics(t, s, u, f):
        v, (roll, pitch, yaw), (p, q, r) = s["v"], s["angles"], s["rates"]
        (sr, cr), (sp, cp), (sy, cy) = ((jnp.sin(a), jnp.cos(a)) for a in (roll, pitch, yaw))
        jx, jy, jz = inertia
        return {
            "x": (
                cp * cy * v[0] + (sr * sp * cy - cr * sy) * v[1] + (cr * sp * cy + sr * sy) * v[2],
                cp * sy * v[0] + (sr * sp * sy + cr * cy) * v[1] + (cr * sp * sy - sr * cy) * v[2],
                sp * v[0] - sr * cp * v[1] - cr * cp * v[2],
            ),
            "v": (
                r * v[1] - q * v[2] - gravity * sp,
                p * v[2] - r * v[0] + gravity * cp * sr,
                q * v[0] - p * v[1] + gravity * (cp * cr - 1) - u[0] / mass,
            ),
            "angles": (
                p + (sr * q + cr * r) * sp / cp, cr * q - sr * r, (sr * q + cr * r) / cp,
            ),
            "rates": (
                (jy - jz) / jx * q * r + u[1] / jx, (jz - jx) / jy * p * r + u[2] / jy,
                (jx - jy) / jz * p * q,
            ),
        }  # fmt: skip

    names = ["north", "east", "height", "ahead", "aside", "down"]

    def problem(threshold):
        def initial(f, key):
            zeros = (0 * f["north"],) * 3
            start = [f[name] for name in names]
            return {"x": tuple(start[:3]), "v": tuple(start[3:]), "angles": zeros, "rates": zeros}

        system = vj.ode(
            dynamics, initial, dt=0.05, duration=5.0, control_period=0.1,
            controller=lambda t, s, f: control(
                s["x"][2], *s["v"], *s["angles"][:2], *s["rates"][:2]
            ),
            signals=lambda t, s, u, f: {"height": s["x"][2]},
        )  # fmt: skip
        space = {name: vj.Box(-0.4, 0.4) for name in names}
        return vj.Problem(
            "quadrotor", space, system, f"always[4, 5] abs(height - 1) <= {threshold!r}"
        )

    return problem, 1.0, -1.0


PROBLEMS = {"integrator": double_integrator, "pendulum": pendulum, "tora": tora,
            "oscillator": van_der_pol, "acc": cruise, "quadrotor": quadrotor}  # fmt: skip


def tightened(make: Callable, threshold: float, sign: float):
    """Return the problem at the tightest threshold that samples allow, but for a tenth of it."""
    run = vj.falsify(make(threshold), "uniform", 20_000, progress=False)
    margin = float(run.table.all["rho"].min())
    print(f"  threshold {threshold:z.4g} leaves {margin:z.4g}; ", end="")
    threshold += sign * (1 - MARGIN) * abs(margin) if margin > 0 else -sign * 1.1 * abs(margin)
    print(f"taken is {threshold:z.4g}")
    return make(threshold)


def main() -> None:
    """Verify the problems named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", default=list(PROBLEMS))
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--check", type=int, default=0, help="uniform samples against the proofs")
    options = parser.parse_args()
    for name in options.names:
        print(name)
        make, threshold, sign = PROBLEMS[name]()
        problem = tightened(make, threshold, sign)
        result = vj.verify(problem, stop=vj.Stop(seconds=options.seconds), progress=False)
        print(result)
        print(f"  decided      {result.proved.mass + result.throughout.mass:.2%}")
        begun = time.perf_counter()
        wrong = contradictions(problem, result, options.check) if options.check else 0
        if options.check:
            print(f"  samples      {options.check:,}, {wrong} in proved boxes fail, "
                  f"{time.perf_counter() - begun:.0f} s")  # fmt: skip


def contradictions(problem: vj.Problem, result: vj.Verification, count: int) -> int:
    """Count failing samples that lie in boxes which are proved."""
    simulate, random, wrong = Evaluator(problem, batch=8192), np.random.default_rng(1), 0
    boxes = result.boxes[result.verdicts == "proved"]
    for begin in range(0, count, 1_000_000):
        points = random.random((min(count - begin, 1_000_000), problem.space.dim), np.float32)
        for point in points[simulate(points).violated]:
            wrong += bool(np.any(np.all((boxes.low <= point) & (point <= boxes.high), axis=1)))
    return wrong


if __name__ == "__main__":
    main()
