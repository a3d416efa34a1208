"""Functions that JAX traces keep nothing and draw nothing, or are refused by the name of it."""

import collections
import itertools
import random
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.core.compute.purity import watch
from verifai_jax.problem.problem import ProblemError

HISTORY = collections.deque(maxlen=3)
COUNT = itertools.count()
GENERATOR = np.random.default_rng(0)
TOTAL = 0.0


class Pid:
    def __init__(self):
        self.integral = 0.0

    def __call__(self, x):
        self.integral = self.integral + 0.1 * x
        return -self.integral


class Last:
    seen = None

    def act(self, x):
        made = x if Last.seen is None else x - Last.seen
        Last.seen = x
        return made


def averages(x):
    HISTORY.append(x)
    return sum(HISTORY)


def adds(x):
    global TOTAL
    TOTAL = TOTAL + x
    return TOTAL


def default(x, memory=[0.0]):  # noqa: B006
    memory[0] = memory[0] + x
    return memory[0]


def steps():
    at, total = 0, 0.0
    while True:
        total = total + (yield total * at)
        at += 1


def counted():
    n = 0

    def count(x):
        nonlocal n
        n += 1
        return n * x

    return count


def sent():
    generator = steps()
    next(generator)
    return lambda x: generator.send(x)


IMPURE = {
    "attribute 'integral' of Pid": Pid(),
    "attribute 'seen' of Last": Last().act,
    "global variable 'HISTORY'": averages,
    "global variable 'TOTAL'": adds,
    "the default argument 'memory' of default": default,
    "variable 'n' of count": counted(),
    "variable 'total' of steps": sent(),
    "global variable 'COUNT'": lambda x: x * next(COUNT),
    "global variable 'GENERATOR'": lambda x: x + GENERATOR.normal(),
    "computes with other numbers": lambda x: x + np.random.rand(),  # noqa: NPY002
    "other numbers each time": lambda x: x + random.random(),
    "numbers each time": lambda x: x + time.perf_counter(),
    "each time that it is called": lambda x: x + np.random.default_rng().normal(),
}


def traced(function):
    return watch(function, lambda: jax.make_jaxpr(lambda x: function(x))(1.0))


@pytest.mark.parametrize("named", IMPURE)
def test_what_is_kept_or_drawn_is_named(named):
    assert named in traced(IMPURE[named]).why_impure


def test_what_is_pure_is_left_alone():
    calls, cache, late = [], {}, [0]

    def logs(x):
        calls.append(1)
        return 2 * x

    def caches(x):
        return cache.setdefault("gain", np.float32(3)) * x

    def switches(x):
        late[0] += 1
        return x if late[0] < 100 else -x

    for function in (jnp.sin, caches, jax.jit(lambda x: x + 1)):
        assert traced(function).why_impure is None
        assert traced(function).kept == ()
    assert traced(logs).why_impure is None
    assert traced(switches).kept == ("variable 'late' of switches",)


def problem(controller=None, dynamics=lambda t, s, u, f: {"x": u}, **options):
    loop = vj.ode(dynamics, lambda f, k: {"x": f["a"]}, controller=controller, dt=0.1, steps=5)
    return vj.Problem(
        "p", options.pop("space", {"a": vj.Box(0, 1)}), loop, "always x < 2", **options
    )


def test_every_door_is_watched():
    pid = Pid()
    with pytest.raises(ProblemError, match="keeps attribute 'integral' of Pid from one call"):
        problem(lambda t, s, f: pid(s["x"])).check()
    with pytest.raises(ProblemError, match="keeps attribute 'integral' of Pid"):
        problem(None, lambda t, s, u, f: {"x": pid(s["x"])}).check()
    still = lambda t, s, f: -s["x"]  # noqa: E731
    judges = "what judges the simulations of problem 'p' keeps attribute 'integral' of Pid"
    space = vj.FeatureSpace({"a": vj.Box(0, 1)}, where=lambda f: pid(f["a"]) < 9)
    with pytest.raises(ProblemError, match=judges):
        problem(still, space=space).check()
    with pytest.raises(ProblemError, match=judges):
        problem(still, guide=lambda trace, features: pid(features["a"])).check()


@pytest.mark.addons
def test_a_control_that_is_none_is_said():
    with pytest.raises(ProblemError, match="controller must return the control; it returned None"):
        problem(lambda t, s, f: None).check()
    with pytest.raises(ProblemError, match="a control, which is None without controller="):
        problem(None, lambda t, s, u, f: {"x": -u}).check()
    unsteered = vj.ode(
        lambda t, s, u, f: -s, lambda f, key: f["a"], dt=0.1, steps=3,
        signals=lambda t, s, u, f: {"x": u[0]},
    )  # fmt: skip
    with pytest.raises(ProblemError, match="signals computes with a control, which is None with"):
        vj.Problem("p", {"a": vj.Box(0, 1)}, unsteered, "always x < 1").check()
    counting = vj.ode(
        lambda t, s, u, f: sum(s for _ in range(s)), lambda f, key: f["a"], dt=0.1, steps=3
    )
    with pytest.raises(ProblemError, match=r"counts by a value, as range.*fori_loop"):
        vj.Problem("p", {"a": vj.Box(0, 1)}, counting, "always state < 1").check()
    order = r"the order is Problem\(name, space, system, spec\)"
    with unchecked(), pytest.raises(ProblemError, match=order):
        vj.Problem("p", unsteered, {"a": vj.Box(0, 1)}, "always x < 1")
    with pytest.raises(ValueError, match="a function from a policy to its problem, and a list of"):
        vj.certify([1.0], lambda policy: problem())
