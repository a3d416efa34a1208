"""About the differential equation itself: no solution leaves its bounds, at any time."""

import json
import runpy
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import verifai_jax as vj
from verifai_jax.addons.verification.continuous import between_samples
from verifai_jax.addons.verification.enclosure import Enclosure
from verifai_jax.addons.verification.sets import MissingRule


def oscillator(t, s):
    return s[1], -s[0]


def van_der_pol(t, s):
    return s[1], (1 - s[0] * s[0]) * s[1] - s[0]


def lorenz(t, s):
    return 10 * (s[1] - s[0]), s[0] * (28 - s[2]) - s[1], s[0] * s[1] - 8 / 3 * s[2]


def pendulum(t, s):
    sin = np.sin if isinstance(t, float) else jnp.sin
    cos = np.cos if isinstance(t, float) else jnp.cos
    return s[1], -9.81 * sin(s[0]) - 0.1 * s[1] + 0.5 * cos(2 * t)


SYSTEMS = {
    "oscillator": (oscillator, 0.1, 6.0, [(-2, 2)] * 2),
    "van der Pol": (van_der_pol, 0.05, 3.0, [(-2, 2)] * 2),
    "Lorenz": (lorenz, 0.01, 0.5, [(-10, 10), (-10, 10), (10, 30)]),
    "pendulum": (pendulum, 0.05, 3.0, [(-1, 1)] * 2),
}


def of_equations(name, spec, **options):
    rates, dt, duration, box = SYSTEMS[name]
    names = [f"x{i}" for i in range(len(box))]
    system = vj.ode(
        lambda t, s, u, f: tuple(rates(t, s)), lambda f, key: tuple(f[n] for n in names), dt=dt,
        duration=duration, signals=lambda t, s, u, f: dict(zip(names, s, strict=True)), **options,
    )  # fmt: skip
    space = {n: vj.Box(*ends) for n, ends in zip(names, box, strict=True)}
    return vj.Problem(name, space, system, spec)


def escapes(name, boxes, seed=0):
    """Return how far solutions leave the bounds of their extremes over time, and the widths."""
    rates, dt, duration, box = SYSTEMS[name]
    dim, random = len(box), np.random.default_rng(seed)
    spec = {f"{end}{i}": f"always x{i} {end} 0" for i in range(dim) for end in (">=", "<=")}
    enclosure = Enclosure(between_samples(of_equations(name, spec)), "float64")
    width = 2.0 ** -random.integers(3, 9, (boxes, 1)) * np.ones((1, dim))
    low = np.floor(random.random((boxes, dim)) / width) * width
    with np.errstate(all="ignore"):
        leaves = enclosure._leaves(low, low + width)
        rho = enclosure._evaluated(enclosure._verdict, leaves, boxes)[0].bounds()
    ends = np.array(box, float).T
    point = low + random.integers(0, 3, low.shape) / 2 * width
    worst, wide = -np.inf, []
    for u, lowest, highest in zip(point, *rho, strict=True):
        found = solve_ivp(rates, (0.0, duration), ends[0] + u * (ends[1] - ends[0]), "DOP853",
                          rtol=1e-12, atol=1e-12, max_step=dt / 2,
                          t_eval=np.linspace(0, duration, 20_001))  # fmt: skip
        seen = np.stack([found.y.min(1), -found.y.max(1)], 1).ravel()
        if np.isfinite(lowest).all():
            # Between two times of the reference, 3e-4 apart at most, it may be some 1e-6 lower.
            worst = max(worst, np.max(lowest - seen), np.max(seen - highest - 1e-6))
            wide.append(np.max(highest - lowest))
    return worst, np.array(wide)


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_solutions_stay_within_their_bounds(name):
    """Against DOP853 at a tolerance of 1e-12 from middles, corners and faces of boxes."""
    worst, wide = escapes(name, 24)
    assert len(wide) > 8
    assert worst < 1e-9
    assert np.min(wide) < 0.5


def wave(**options):
    """Return an oscillator of which samples at half its period, of a true method, see no wave."""
    system = vj.ode(
        lambda t, s, u, f: (s[1], -s[0]), lambda f, key: (0 * f["x"], 2 + 0 * f["x"]), dt=np.pi,
        steps=2, signals=lambda t, s, u, f: {"x": s[0]},
        method=lambda rates, t, s, dt: (-s[0], -s[1]), **options,
    )  # fmt: skip
    return vj.Problem("wave", {"x": vj.Box(0, 1)}, system, "always x <= 1.5")


@pytest.mark.slow
def test_a_wave_between_samples_is_seen():
    problem = wave()
    assert vj.verify(problem, boxes=1, samples=0, progress=False).proved.mass == 1
    found = vj.verify(problem, boxes=1, continuous=True, progress=False)
    assert found.proved.mass == 0
    assert found.failure_bound == 1
    assert "the differential equation at all times" in str(found)
    with pytest.raises(ValueError, match=r"is about the differential equation.*continuous=False"):
        vj.estimate(problem, proved=found, precision="float64")


@pytest.mark.thorough
def test_a_held_controller_and_its_saturation_are_part_of_the_equation():
    """`x' = -clip(2 x)` with a sample of x a second: `x - 1` after a second, and `-x` later."""
    system = vj.ode(
        lambda t, s, u, f: {"x": jnp.clip(u, -1.0, 1.0)}, lambda f, key: {"x": f["x"]}, dt=0.25,
        duration=2.0, control_period=1.0, controller=lambda t, s, f: -2.0 * s["x"],
        signals=lambda t, s, u, f: s,
    )  # fmt: skip
    problem = vj.Problem("held", {"x": vj.Box(1.0, 1.4)}, system, {
        "above": "always x >= -0.4001", "below": "always[1.25, 2] x <= 0.3001",
    })  # fmt: skip
    found = vj.verify(problem, boxes=1, continuous=True, progress=False)
    assert found.proved.mass == 1
    tight = vj.Problem("held", problem.space, system, "always[1, 2] x >= -0.35")
    found = vj.verify(tight, boxes=6, continuous=True, progress=False)
    assert 0.5 <= found.proved.mass <= 0.875
    assert found.broken.mass > 0


def plant(rates, spec="always x <= 1", **options):
    system = vj.ode(rates, lambda f, key: {"x": f["x"]}, dt=0.1, duration=1.0, **options)
    return vj.Problem("plant", {"x": vj.Box(0, 1)}, system, spec)


def smooth(t, s, u, f):
    return {"x": -s["x"]}


@pytest.mark.parametrize(
    ("problem", "message"),
    [
        (plant(lambda t, s, u, f: {"x": -jnp.abs(s["x"])}), r"the dynamics apply abs to the state"),
        (plant(lambda t, s, u, f: {"x": jnp.where(t > 0.5, s["x"], 0)}), "the dynamics apply gt"),
        (plant(smooth, terminate=lambda s, f: s["x"] > 1), "'plant' has terminate="),
        (plant(smooth, exact_step=True), "'plant' has exact_step="),
        (plant(smooth, "(x >= 0) until (x <= 0.5)"), "until.* is about single samples"),
        (plant(smooth, "always (x <= 1 | next x <= 1)"), "next.* is about single samples"),
        (plant(smooth, "always duration(prev x <= 1, 0.5) <= 1"), "prev.* is about single samples"),
        (plant(smooth, "always(0,1] x <= 1"), r"needs closed windows.*not the \(0,1\] of"),
        (plant(smooth, "always duration(once[0,0.5) x <= 1, 0.5) <= 1"), r"not the \[0,0\.5\) of"),
        (vj.Problem("function", {"x": vj.Box(0, 1)},
                    lambda f, key: vj.Trace({"x": f["x"] * jnp.ones(2)}, dt=1.0), "always x <= 1"),
         "continuous=True is about the equations of a system that vj.ode made"),
    ],
)  # fmt: skip
def test_what_an_equation_does_not_say_is_refused(problem, message):
    with pytest.raises((vj.ProblemError, MissingRule), match=message):
        Enclosure(between_samples(problem), "float64")


@pytest.mark.slow
def test_windows_within_windows_a_jump_and_a_held_network_are_those_of_solutions():
    """Against DOP853 from sample to sample, at 200 times each; `v` turns around at one second."""
    inner, outer = np.random.default_rng(0).normal(size=(2, 8, 2)) / 2

    def held(x, v, n=jnp):
        return n.clip(outer[:, 0] @ n.tanh(inner @ n.stack([x, v])), -1.0, 1.0)

    def turned(t, s, f):
        return {"x": s["x"], "v": jnp.where(jnp.abs(t - 1) < 0.01, -s["v"], s["v"])}

    system = vj.ode(
        lambda t, s, u, f: {"x": s["v"], "v": u - f["k"] * jnp.sin(s["x"]) + jnp.cos(3 * t) / 9},
        lambda f, key: {"x": f["x"], "v": f["v"]}, dt=0.1, duration=2.0, control_period=0.2,
        controller=lambda t, s, f: held(s["x"], s["v"]), signals=lambda t, s, u, f: s,
        update=turned,
    ).refined(2)  # fmt: skip
    space = {"x": vj.Box(-1, 1), "v": vj.Box(-1, 1), "k": vj.Box(0.5, 2)}
    problem = vj.Problem("held", space, system, {
        "low": "always x >= 0", "slow": "always[0.5, 1] v >= 0",
        "fast": "eventually[1, 1.5] v >= 0",
        "soon": "always[0, 1] eventually[0.2, 0.5] x >= 0",
        "once": "always[1, 2] once[0.2, 0.5] x >= 0",
    })  # fmt: skip
    enclosure, random = Enclosure(between_samples(problem), "float64"), np.random.default_rng(3)
    width = 2.0 ** -random.integers(4, 9, (20, 1)) * np.ones((1, 3))
    low = np.floor(random.random((20, 3)) / width) * width
    rho = enclosure._evaluated(enclosure._verdict, enclosure._leaves(low, low + width), 20)
    for u, lowest, highest in zip(low + width / 2, *rho[0].bounds(), strict=True):
        state, k, parts = 2 * u[:2] - 1, 0.5 + 1.5 * u[2], []
        for j in range(20):
            control = held(*state, np) if j % 2 == 0 else control
            times = np.linspace(j / 10, (j + 1) / 10, 201)
            part = solve_ivp(
                lambda t, y, u=control, k=k: [y[1], u - k * np.sin(y[0]) + np.cos(3 * t) / 9],
                times[[0, -1]], state, "DOP853", t_eval=times, rtol=1e-12, atol=1e-12,
            )  # fmt: skip
            state = part.y[:, -1] * [1, -1 if j == 9 else 1]
            parts.append([part.t[:-1], *part.y[:, :-1]])
        t, x, v = np.concatenate([*parts, [[2.0], *state[:, None]]], 1)

        def most(a, b, t=t, x=x):
            return x[(a - 1e-9 <= t) & (t <= b + 1e-9)].max()

        seen = np.array([
            x.min(), v[(t > 0.5 - 1e-9) & (t < 1 + 1e-9)].min(),
            v[(t > 1 - 1e-9) & (t < 1.5 + 1e-9)].max(),
            min(most(a + 0.2, a + 0.5) for a in np.linspace(0, 1, 401)),
            min(most(a - 0.5, a - 0.2) for a in np.linspace(1, 2, 401)),
        ])  # fmt: skip
        assert np.all(lowest - 1e-6 <= seen)
        assert np.all(seen <= highest + 1e-6)
        assert np.max(highest - lowest) < 0.4


DURATIONS = {
    "last": "always duration(x > 0.5, 2) <= 0.6",
    "shifted": "always[1, 3] duration(v <= 0.5, [0.5, 2]) >= 0.1",
    "product": "eventually[0, 2] duration(x * v > 0, (0.2, 1.7]) > 0.3",
    "sum": "always[1, 3] 2 * duration(once[0.2, 0.4] x > 0.5, 1.2) - x <= 3",
    "nested": "eventually (x < 0.3 & duration(duration(x > 0, 1) > 0.45, 2) >= 0.4)",
    "step": "always duration(x > 0, [0.3, 0.35]) <= 0.04",
    "instant": "always duration(x > 0, [1, 1]) <= 1",
}  # fmt: skip


@pytest.mark.thorough
def test_durations_are_those_of_solutions():
    """Against sums over fifty parts of each step of solutions by DOP853."""
    system = vj.ode(
        lambda t, s, u, f: {"x": s["v"], "v": -f["k"] * s["x"] + 0.3 * jnp.cos(2 * t)},
        lambda f, key: {"x": f["x"], "v": f["v"]}, dt=0.05, duration=4.0,
        signals=lambda t, s, u, f: s,
    )  # fmt: skip
    space = {"x": vj.Box(0, 1), "v": vj.Box(-1, 1), "k": vj.Box(2, 5)}
    problem = vj.Problem("durations", space, system, DURATIONS)
    enclosure, random = Enclosure(between_samples(problem), "float64"), np.random.default_rng(0)
    width = 2.0 ** -random.integers(4, 13, (30, 1)) * np.ones((1, 3))
    low = np.floor(random.random((30, 3)) / width) * width
    rho = enclosure._evaluated(enclosure._verdict, enclosure._leaves(low, low + width), 30)
    times = np.linspace(0, 4, 4001)

    def at(seconds):
        return round(1000 * seconds)

    def lasts(holds, first, last):
        """Return the seconds within a window before each time."""
        holds = holds.astype(float)
        total = np.concatenate([[0], np.cumsum(holds[1:] + holds[:-1]) / 2000])
        begin, end = (total[np.maximum(np.arange(4001) - at(s), 0)] for s in (last, first))
        return end - begin

    def once(holds, first, last):
        row = np.concatenate([np.zeros(at(last), bool), holds])
        views = np.lib.stride_tricks.sliding_window_view(row, at(last) + 1)
        return views[:, : at(last) - at(first) + 1].any(1)

    for u, lowest, highest in zip(
        low + width * random.random((30, 3)), *rho[0].bounds(), strict=True
    ):
        x, v = solve_ivp(
            lambda t, y, k=2 + 3 * u[2]: [y[1], -k * y[0] + 0.3 * np.cos(2 * t)], (0, 4),
            [u[0], 2 * u[1] - 1], "DOP853", t_eval=times, rtol=1e-10, atol=1e-10,
        ).y  # fmt: skip
        between, early = slice(at(1), at(3) + 1), slice(at(2) + 1)
        seen = np.array([
            (0.6 - lasts(x > 0.5, 0, 2)).min(), (lasts(v <= 0.5, 0.5, 2) - 0.1)[between].min(),
            (lasts(x * v > 0, 0.2, 1.7) - 0.3)[early].max(),
            (3 - 2 * lasts(once(x > 0.5, 0.2, 0.4), 0, 1.2) + x)[between].min(),
            np.minimum(0.3 - x, lasts(lasts(x > 0, 0, 1) > 0.45, 0, 2) - 0.4).max(),
            (0.04 - lasts(x > 0, 0.3, 0.35)).min(), 1.0,
        ])  # fmt: skip
        # A crossing is known to a thousandth of a second.
        assert np.all(lowest - 4e-3 <= seen)
        assert np.all(seen <= highest + 4e-3)
    wide = np.median(rho[0].bounds()[1] - rho[0].bounds()[0], axis=0)
    assert np.all(wide <= 0.3), wide


def falling(spec):
    """Return `x' = -x` from 1 to 1.1: above a half for 0.69 to 0.79 seconds."""
    system = vj.ode(
        lambda t, s, u, f: {"x": -s["x"]}, lambda f, key: {"x": f["x"]}, dt=0.05, duration=2.0
    )
    return vj.Problem("falling", {"x": vj.Box(1, 1.1)}, system, spec)


@pytest.mark.thorough
def test_a_duration_is_proved_up_to_what_a_step_leaves_open():
    kept, broken, early = (
        vj.verify(falling(spec), boxes=8, continuous=True, progress=False) for spec in (
            "always duration(x > 0.5, 2) <= 0.85", "always duration(x > 0.5, 2) <= 0.6",
            "always[0, 1] duration(x > 0.5, 1) >= 0",
        )
    )  # fmt: skip
    assert kept.proved.mass == early.proved.mass == 1
    assert broken.throughout.mass == 1


EXAMPLES = Path(__file__).parents[3] / "examples" / "verification"


@pytest.mark.thorough
def test_a_proof_about_a_plant_is_checked_again_by_another_program(tmp_path):
    pytest.importorskip("mpmath")
    problem = runpy.run_path(str(EXAMPLES / "held_pendulum_problem.py"))["problem"]
    boxes, plant = tmp_path / "boxes.json", tmp_path / "plant.py"
    found = vj.verify(problem, boxes=1, continuous=True, progress=False)
    assert found.proved.mass == 1
    found.save(boxes)

    def checked(highest):
        text = (EXAMPLES / "held_pendulum.py").read_text()
        plant.write_text(text.replace("HIGHEST = 0.42", f"HIGHEST = {highest}"))
        command = [sys.executable, EXAMPLES / "check_plant.py", plant, boxes]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    assert checked(0.42).stdout == "1 boxes are proved, 1 of the features\n"
    assert checked(0.35).stderr == "box 1 is not proved\n"
    record = json.loads(boxes.read_text())
    for end in ("low", "high", "state"):
        record["boxes"][end] *= 2
    boxes.write_text(json.dumps(record))
    assert checked(0.42).stderr == "two boxes overlap\n"
