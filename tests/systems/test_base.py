"""Anything that can be called becomes a `System`, which offers what it has and refuses the rest."""

import jax
import jax.numpy as jnp
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.core.values.trace import Trace
from verifai_jax.systems.base import System, as_system

SPACE = {"x": vj.Box(-1.0, 1.0)}


def constant(features, key):
    return Trace({"x": features["x"] * jnp.ones(3)}, dt=1.0)


class Half(System):
    """Nothing but a call."""

    def __call__(self, features, key=None):
        return constant({"x": 0.5 * features["x"]}, key)


class Duck:
    """Offers some of what a system may, without being one."""

    lanes = 64
    reverse_hint = None
    check = "no function"

    def __call__(self, features, key=None):
        return constant(features, key)

    def refined(self, factor):
        return lambda features, key: constant({"x": features["x"] / factor}, key)


def test_a_system_is_itself():
    system = Half()
    assert as_system(system) is system
    assert vj.Problem("half", SPACE, system, "always x <= 1").system is system


def test_a_function_is_wrapped_once_for_jax():
    one, other = as_system(constant), as_system(constant)
    assert isinstance(one, System)
    assert one == other
    assert hash(one) == hash(other)
    assert one != as_system(lambda features, key: constant(features, key))
    assert repr(one) == repr(constant)
    problem = vj.Problem("constant", SPACE, constant, "always x <= 1")
    assert problem.system == one
    assert vj.Problem("again", SPACE, problem.system, "x <= 1").system is problem.system


def test_a_system_offers_nothing_unless_it_says_so():
    for system in (Half(), as_system(constant)):
        assert not system.black_box
        assert (system.lanes, system.forward_up_to, system.reverse_hint) == (512, 1, "")
        assert (system.backends, system.backend, system.likely) == ((), None, None)
        offered = (
            system.can_fold,
            system.can_refine,
            system.can_simulate_batch,
            system.can_simulate_each,
        )
        assert not any(offered)
        system.check({"unknown": 1.0})
        form = system.abstract({"x": jax.ShapeDtypeStruct((), jnp.float32)})
        assert form.signals["x"].shape == (3,)
        assert system.why_not("mjx") == "the system has no such backend"


@pytest.mark.parametrize("system", [Half(), as_system(constant)])
def test_what_is_not_offered_is_refused_by_name(system):
    with pytest.raises(NotImplementedError, match=r"has no refined\(factor\)"):
        system.refined(2)
    with pytest.raises(NotImplementedError, match=r"has no fold\(features, key, carry, update\)"):
        system.fold({}, None, 0, max)
    with pytest.raises(NotImplementedError, match=r"has no rollout\(features, key\)"):
        system.forks({})
    with pytest.raises(NotImplementedError, match="has no simulate_batch"):
        system.simulate_batch({}, jax.random.split(jax.random.key(0), 2))
    with pytest.raises(NotImplementedError, match="has no simulate_each"):
        system.simulate_each([], [])
    with pytest.raises(ValueError, match="has no backends to choose from; got backend 'mjx'"):
        system.with_backend("mjx")


def test_what_an_object_offers_is_taken_up():
    system = as_system(Duck())
    assert system.lanes == 64
    assert system.reverse_hint == ""
    system.check({})  # What is called check is no function.
    assert system.can_refine
    finer = system.refined(4)
    assert isinstance(finer, System)
    assert finer({"x": 1.0})["x"][0] == 0.25


def test_what_overrides_is_offered():
    class Finer(Half):
        def refined(self, factor):
            return self

    assert Finer().can_refine
    assert not Finer().can_fold


def test_a_system_of_an_exact_step_has_no_finer_one():
    class Finer(Half):
        exact_step = True

        def refined(self, factor):
            return self

    class Environment(Duck):
        exact_step = True

    assert not Half().exact_step
    assert not as_system(Duck()).exact_step
    assert not Finer().can_refine
    assert as_system(Environment()).exact_step
    assert not as_system(Environment()).can_refine


def test_what_cannot_be_called_is_refused():
    with pytest.raises(ValueError, match=r"must be a function .* -> Trace; got 3"):
        as_system(3)
    refused = pytest.raises(vj.ProblemError, match=r"must be a function .* -> Trace; got 3")
    with unchecked(), refused:
        vj.Problem("three", SPACE, 3, "x <= 1")
    with pytest.raises(NotImplementedError, match=r"System has no __call__\(features, key\)"):
        System()({})
