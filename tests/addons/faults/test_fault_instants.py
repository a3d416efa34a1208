"""Onsets, durations, holds and delays off the grid of instants, against exact fractions."""

import math
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons import faults

STEPS = 24
PERIODS = {"0.1": Fraction(1, 10), "0.3": Fraction(3, 10), "1/3": Fraction(1, 3)}
OFFSETS = (Fraction(0), Fraction(1, 4), Fraction(1, 2), Fraction(3, 4))
LENGTHS = (Fraction(1), Fraction(3, 2), Fraction(2), Fraction(5, 2), Fraction(7, 2))


def course(k):
    return 1.0 + 0.3 * k - 0.012 * k * k


def by_hand(kind, onset, duration, amount):
    """Return what the channel reads at each instant, all times in periods."""
    read, kept, begun = [], None, None
    nearest = math.floor(amount + Fraction(1, 2))
    for k in range(STEPS):
        live = onset <= k < onset + duration
        value = course(k)
        if live and begun is None:
            begun = k
        if live and kind == "freeze":
            value = course(max(begun - 1, 0))
        elif live and kind == "held":
            kept = value if k == 0 or (k - begun) % max(nearest, 1) == 0 else kept
            value = kept
        elif live and kind == "delay":
            value = course(max(k - nearest, 0))
        elif live and kind == "drift":
            value += float((k - onset) * amount)
        elif live:
            value = -7.0
        read.append(value)
    return read


CASES = [(4 + offset, length + 6 + offset / 2, length) for offset in OFFSETS for length in LENGTHS]


@pytest.fixture(scope="module", params=PERIODS)
def period(request):
    return PERIODS[request.param]


def made(kind, **numbers):
    """Return a fault of a kind; `amount` is its number, in the unit of the case."""
    amount = numbers.pop("amount")
    options = {
        "dropout": (faults.Dropout, {"value": -7.0}), "freeze": (faults.Freeze, {}),
        "held": (faults.HeldAction, {"hold": amount}), "delay": (faults.Delay, {"seconds": amount}),
        "drift": (faults.Drift, {"rate": amount}),
    }  # fmt: skip
    make, own = options[kind]
    return make("observation", **own, **numbers)


KINDS = ("dropout", "freeze", "held", "delay", "drift")


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_on_the_host(kind, period):
    for onset, duration, amount in CASES:
        unit = 1 / period if kind == "drift" else period
        fault = made(
            kind, amount=float(amount * unit), onset=float(onset * period),
            duration=float(duration * period), name="f",
        )  # fmt: skip
        host = faults.on_host([fault], {}, period=float(period))
        read = [float(host.observation(k * float(period), course(k))) for k in range(STEPS)]
        np.testing.assert_allclose(read, by_hand(kind, onset, duration, amount), atol=1e-9)


@pytest.mark.thorough
def test_in_a_compiled_loop_in_single_precision(period):
    dt = float(period)
    plant = vj.ode(
        lambda time, state, control, features: {"x": jnp.zeros(())},
        lambda features, key: {"x": jnp.float32(course(0))},
        controller=lambda time, state, features: {"seen": state["x"]},
        update=lambda time, state, features: {"x": course(jnp.round(time / dt))},
        dt=dt, steps=STEPS, signals=lambda time, state, control, features: control,
    )  # fmt: skip
    wide = vj.Box(0, 100)
    for kind in KINDS:
        fault = made(kind, amount=wide, onset=wide, duration=wide, name="f")
        fault = type(fault)(**{**vars(fault), "channel": "x"})
        system = (
            vj.Problem("course", {"any": vj.Box(0, 1)}, plant, "always seen < 99")
            .with_faults(fault)
            .system
        )
        unit = 1 / period if kind == "drift" else period
        own = {"held": "hold", "delay": "seconds", "drift": "rate"}.get(kind)
        rows = [
            {"onset": o * period, "duration": d * period, **({own: a * unit} if own else {})}
            for o, d, a in CASES
        ]
        batch = {n: jnp.array([float(row[n]) for row in rows], jnp.float32) for n in rows[0]}
        simulate = jax.vmap(
            lambda numbers, s=system: s({"any": 0.0, "f": numbers}, jax.random.key(0))
        )
        read = np.asarray(jax.jit(simulate)(batch).signals["seen"])[:, :STEPS]
        right = [by_hand(kind, *case) for case in CASES]
        np.testing.assert_allclose(read, right, atol=2e-4)


def test_late_instants_are_met_in_single_precision():
    """At 600 s a float32 number is rounded to six thousandths of a period."""
    steps = 60_000
    fault = faults.Dropout("observation", value=-7.0, onset=599.87, duration=0.05, name="f")
    plain = {**vars(fault), "onset": float(np.float32(599.87))}
    host = faults.on_host([faults.Dropout(**plain)], {}, period=0.01)
    read = [float(host.observation(k * 0.01, 1.0)) for k in range(steps - 40, steps)]
    assert np.flatnonzero(np.array(read) == -7.0).tolist() == [27, 28, 29, 30, 31]
