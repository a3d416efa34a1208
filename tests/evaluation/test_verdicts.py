"""The law that says which simulations violate the property, and the result that carries it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.core.compute.compilation import ProgramCache, Slot
from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.evaluation.verdicts import Verdicts, trace_verdict, violations

OK, LOST = int(Status.OK), int(Status.NONFINITE)


def never():
    raise AssertionError("the Boolean semantics were asked for without need")


@pytest.mark.parametrize(
    ("rho", "status", "holds", "violated"),
    [
        ([1.0, 2.0], OK, never, False),
        ([1.0, -2.0], OK, never, True),
        ([0.0, -2.0], OK, never, True),
        ([0.0, 2.0], OK, [True, True], False),
        ([0.0, 2.0], OK, [False, True], True),
        ([0.0, 0.0], OK, [True, False], True),
        ([np.nan, np.nan], LOST, never, False),
        ([-1.0, 0.0], LOST, never, False),
    ],
)
def test_the_law(rho, status, holds, violated):
    semantics = holds if callable(holds) else lambda: np.array([holds])
    found = violations(np.array([rho]), np.array([status]), semantics)
    assert found.tolist() == [violated]


def test_one_undecided_row_does_not_change_the_others():
    rho = np.array([[-1.0], [0.0], [1.0], [np.nan]])
    status = np.array([OK, OK, OK, LOST])
    # What the semantics say of rows that are decided already must not matter.
    found = violations(rho, status, lambda: np.array([[True], [False], [False], [False]]))
    assert found.tolist() == [True, True, False, False]


def test_batches_join_in_order():
    first = Verdicts(np.array([[1.0]]), np.array([OK]), np.array([False]))
    second = Verdicts(
        np.array([[np.nan], [-1.0]]),
        np.array([LOST, OK]),
        np.array([False, True]),
        messages=["lost", ""],
    )
    whole = Verdicts.concatenate([first, second])
    assert whole.violated.tolist() == [False, False, True]
    assert whole.proper.tolist() == [True, False, True]
    assert whole.messages == ["", "lost", ""]
    assert Verdicts.nothing(2, 3).lowest.shape == (0,)


def test_parts_of_equal_length_are_split_again():
    numbers = np.arange(6.0)
    whole = Verdicts(
        numbers[:, None],
        np.full(6, OK),
        numbers < 0,
        messages=[str(n) for n in numbers],
        traces=[None] * 6,
    )
    first, second = whole.split(2)
    assert [part.lowest.tolist() for part in (first, second)] == [[0, 1, 2], [3, 4, 5]]
    assert second.messages == ["3.0", "4.0", "5.0"]
    assert second.traces == [None] * 3
    assert Verdicts.concatenate([first, second]).messages == whole.messages


def test_a_program_is_made_once_and_freed_together():
    cache, slot, made = ProgramCache(), Slot[int, list[int]]("lists"), []

    def make():
        made.append(1)
        return [7]

    assert cache.peek(slot, 1) is None
    assert cache.get(slot, 1, make) is cache.get(slot, 1, make)
    assert made == [1]
    cache.clear()
    assert cache.peek(slot, 1) is None


def test_nothing_is_kept_of_a_program_that_fails():
    cache, slot = ProgramCache(), Slot[str, int]("numbers")
    with pytest.raises(ZeroDivisionError):
        cache.get(slot, "a", lambda: 1 // 0)
    assert cache.get(slot, "a", lambda: 2) == 2


def test_codes_that_can_be_none_are_no_verdict_of_a_traced_system():
    x = jnp.array([-1.0, -1.0, 5.0])

    def verdict(valid, status):
        problem = vj.Problem("codes", {"a": vj.Box(0, 1)}, lambda f, k: None, "always x > 0")
        return trace_verdict(problem, Trace({"x": x}, dt=0.1, valid=valid, status=status))[1]

    codes = jax.jit(jax.vmap(verdict))(jnp.array([3, 0, -1, 4, 3]), jnp.array([0, 0, 0, 0, 7]))
    assert [Status(int(c)).name for c in codes] == ["OK", "ERROR", "ERROR", "ERROR", "ERROR"]
