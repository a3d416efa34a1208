"""Temporal operators as functions; times are in seconds, and intervals from `a` to `b` are closed.

An `Interval` given instead of `a` may leave out one of its ends.

always(abs(signal("x")) <= 2.4, 0, 4)
until(signal("request") > 0, signal("grant") > 0, 0.2, 0.6)
"""

import math

from verifai_jax.mtl.formula import (
    Always,
    And,
    Eventually,
    Formula,
    Formulaic,
    Historically,
    Next,
    Not,
    Once,
    Prev,
    Start,
    build,
    formula,
    interval_of,
)


def always(operand: Formulaic, a: Start = 0.0, b: float = math.inf) -> Formula:
    """Require `operand` at every instant from `a` to `b` seconds ahead."""
    return Always(formula(operand), interval_of(a, b))


def eventually(operand: Formulaic, a: Start = 0.0, b: float = math.inf) -> Formula:
    """Require `operand` at some instant from `a` to `b` seconds ahead."""
    return Eventually(formula(operand), interval_of(a, b))


def historically(operand: Formulaic, a: Start = 0.0, b: float = math.inf) -> Formula:
    """Require `operand` at every instant from `a` to `b` seconds ago."""
    return Historically(formula(operand), interval_of(a, b))


def once(operand: Formulaic, a: Start = 0.0, b: float = math.inf) -> Formula:
    """Require `operand` at some instant from `a` to `b` seconds ago."""
    return Once(formula(operand), interval_of(a, b))


def until(left: Formulaic, right: Formulaic, a: Start = 0.0, b: float = math.inf) -> Formula:
    """Require `right` `a` to `b` seconds ahead, and `left` at every earlier instant."""
    return formula(left).until(right, a, b)


def since(left: Formulaic, right: Formulaic, a: Start = 0.0, b: float = math.inf) -> Formula:
    """Require `right` at some instant from `a` to `b` seconds ago, and `left` ever since."""
    return formula(left).since(right, a, b)


def next_(operand: Formulaic) -> Formula:
    """Require `operand` at the next sample."""
    return Next(formula(operand))


def rise(operand: Formulaic) -> Formula:
    """Require `operand` at this sample and not at the previous one; false at the first sample."""
    return build("rise", (formula(operand),))


def fall(operand: Formulaic) -> Formula:
    """Require `operand` at the previous sample and not at this one; false at the first sample."""
    return build("fall", (formula(operand),))


def phase(begins: Formulaic, ends: Formulaic) -> Formula:
    """Return a formula that holds from a sample where `begins` holds until `ends` holds."""
    return (~formula(ends)).since(formula(begins) & ~formula(ends))


def during(phase: Formulaic, operand: Formulaic) -> Formula:
    """Require `operand` at every instant of every phase."""
    return Always(formula(phase).implies(operand))


def sometime_during(phase: Formulaic, operand: Formulaic) -> Formula:
    """Require `operand` at some instant of each phase, before the phase ends."""
    now = formula(phase)
    begins = And((now, Prev(Not(now), weak=True)))
    return Always(begins.implies(now.until(now & formula(operand))))


def prev(operand: Formulaic, weak: bool = False) -> Formula:
    """Require `operand` at the previous sample; at the first sample false (true, if `weak`)."""
    return Prev(formula(operand), weak)
