import math

import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.addons.training.sweeps.curves import check_curve, curve_robustness, curve_trace
from verifai_jax.core.messages.errors import UnknownNameError

STEPS = 1000 * np.arange(1, 9)
RETURN = np.array([np.nan, 20.0, np.nan, 60.0, 95.0, 85.0, np.nan, 70.0])
# What holds at 0, 1000, ..., 8000 steps.
HELD = [20.0, 20.0, 20.0, 20.0, 60.0, 95.0, 85.0, 85.0, 70.0]


def test_the_curve_is_a_trace_over_environment_steps():
    trace = curve_trace(STEPS, RETURN)
    assert str(trace).startswith(f"trace of 9 samples every {STEPS[0]:,} environment steps")
    assert trace["return"].tolist() == HELD
    assert trace.clock().tolist() == [0.0, *STEPS]


def test_reaching_and_keeping_a_return():
    # Best at 5000: min(95 - 90, lowest later return 70 - 50) = 5.
    formula = "eventually[0, 200000] (return >= 90 & always return >= 50)"
    assert curve_robustness(formula, STEPS, RETURN) == pytest.approx(5.0)
    # At 5000 too: min(95 - 90, 70 - 80) = -10, which is the most of all instants.
    formula = "eventually[0, 200000] (return >= 90 & always return >= 80)"
    assert curve_robustness(formula, STEPS, RETURN) == pytest.approx(-10.0)


@pytest.mark.parametrize(
    ("bound", "reached"), [(3999, 20.0), (4000, 60.0), (4999.5, 60.0), (5000, 95.0), (7e6, 95.0)]
)
def test_bounds_are_environment_steps(bound, reached):
    formula = f"eventually[0, {bound}] return >= 0"
    assert curve_robustness(formula, STEPS, RETURN) == pytest.approx(reached)


def test_windows_of_any_start_and_end_agree_with_the_definition():
    clock, held = np.arange(9) * 1000.0, np.array(HELD)
    for start, end in [(0, 2500), (1500, 4200), (3000, 3000), (4100, 4900), (0, 9e9)]:

        def at(time):
            return held[int(min(time // 1000, 8))]

        inside = [at(start), *held[(clock >= start) & (clock <= end)], at(end)]
        formula = f"always[{start}, {end:.0f}] return >= 30"
        assert curve_robustness(formula, STEPS, RETURN) == pytest.approx(min(inside) - 30)


def test_the_last_value_stays():
    assert curve_robustness("always[0, 1000000] return >= 10", STEPS, RETURN) == pytest.approx(10.0)
    assert curve_robustness("always[900000, 1000000] return >= 10", STEPS, RETURN) == pytest.approx(
        60.0
    )


def test_updates_of_different_lengths():
    steps = np.array([1000, 2000, 4000, 5000])
    held = np.array([1.0, 2.0, 9.0, 4.0])
    assert curve_robustness("always[3000, 3000] return >= 0", steps, held) == pytest.approx(2.0)
    assert curve_robustness("eventually return >= 0", steps, held) == pytest.approx(9.0)


def test_without_an_ended_episode_nothing_is_known():
    assert math.isnan(curve_robustness("always return >= 0", STEPS, np.full(8, np.nan)))
    assert math.isnan(curve_robustness("always return >= 0", np.zeros(0, int), np.zeros(0)))
    with pytest.raises(ValueError, match="no episode ended in this training"):
        curve_trace(STEPS, np.full(8, np.nan))


def test_bad_curves_and_formulas_say_what_is_wrong():
    with pytest.raises(UnknownNameError, match=r"signal of a learning curve 'retrun'.*'return'"):
        check_curve("always retrun >= 3")
    with pytest.raises(vj.FormulaSyntaxError):
        check_curve("always (return >= ")
    with unchecked(), pytest.raises(TypeError, match="MTL text or a Formula; got 3"):
        check_curve(3)  # pyright: ignore[reportArgumentType]
    with unchecked(), pytest.raises(ValueError, match=r"shapes \[8\] and \[7\]"):
        curve_trace(STEPS, RETURN[1:])
    with pytest.raises(ValueError, match="positive and increase"):
        curve_trace(STEPS[::-1], RETURN)
