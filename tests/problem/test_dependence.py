"""Does the robustness depend on features through a derivative, and does a verdict on the key?"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.problem.dependence import depends_on_key, has_gradient


@jax.custom_jvp
def flat(x):
    return 2 * x


flat.defjvp(lambda x, t: (flat(x[0]), jnp.zeros_like(t[0])))


@jax.custom_vjp
def steep(x):
    return jnp.floor(x)


steep.defvjp(lambda x: (steep(x), None), lambda _, g: (g,))


def swapped(x):
    # What is carried first depends on x after two rounds alone.
    return jax.lax.scan(lambda c, _: ((c[1], c[2], c[2]), None), (0.0, 0.0, x), None, length=3)[0][
        0
    ]


def counted(x):
    return jax.lax.while_loop(lambda c: c[1] < 3, lambda c: (c[0] + x, c[1] + 1), (0.0, 0))[0]


def counts(x):
    return jax.lax.while_loop(lambda c: c < x, lambda c: c + 1, 0.0)


SIGNALS = {
    "product": (lambda x: 2.0 * x * x, True),
    "floor": (lambda x: jnp.floor(x) + 0.5, False),
    "round of many": (lambda x: jnp.round(jnp.full(3, x)).sum(), False),
    "sign": (lambda x: jnp.sign(x) * 3, False),
    "stopped": (lambda x: jax.lax.stop_gradient(x), False),
    "partly stopped": (lambda x: x - jax.lax.stop_gradient(x), True),
    "compared": (lambda x: jnp.where(x > 0, 1.0, -1.0), False),
    "chosen": (lambda x: jnp.where(x > 0, x, -1.0), True),
    "a whole number": (lambda x: x.astype(jnp.int32).astype(jnp.float32), False),
    "scan": (swapped, True),
    "while": (counted, True),
    "while, by its test alone": (counts, False),
    "cond": (lambda x: jax.lax.cond(x > 0, lambda: jnp.floor(x), lambda: jnp.sin(x)), True),
    "flat cond": (lambda x: jax.lax.cond(x > 0, lambda: jnp.floor(x), lambda: 0.0), False),
    "derivative of its own, zero": (flat, False),
    "derivative of its own": (jax.nn.relu, True),
    "derivative of its own, backwards": (steep, True),
    "checkpoint": (jax.checkpoint(lambda x: jnp.cos(x)), True),
    "scatter": (lambda x: jnp.zeros(3).at[1].set(x).sum(), True),
    "index": (lambda x: jnp.arange(3.0)[x.astype(jnp.int32)], False),
    "solve": (lambda x: jnp.linalg.solve(jnp.eye(2) * (2 + x), jnp.ones(2))[0], True),
    "inner derivative": (lambda x: jax.grad(jnp.sin)(x), True),
    "constant": (lambda x: 1.0, False),
    "itself": (lambda x: x, True),
}


def of_a_derivative(signal):
    """Return the same, from the derivative of the whole as a program."""
    form = jax.ShapeDtypeStruct((), jnp.float32)

    def along(x, direction):
        _, derivative = jax.jvp(lambda x: jnp.asarray(signal(x), jnp.float32), (x,), (direction,))
        return derivative

    program = jax.make_jaxpr(along)(form, form).jaxpr
    moved = {program.invars[1]}
    for step in program.eqns:
        if any(not hasattr(value, "val") and value in moved for value in step.invars):
            moved.update(step.outvars)
    value = program.outvars[0]
    return not hasattr(value, "val") and value in moved


@pytest.mark.parametrize("name", SIGNALS)
def test_dependence_is_that_of_the_derivative(name):
    signal, depends = SIGNALS[name]

    def system(features, key):
        return vj.Trace({"y": jnp.full(2, signal(features["x"])), "other": jnp.zeros(2)}, dt=1.0)

    problem = vj.Problem("p", {"x": vj.Box(-1.0, 1.0)}, system, "always y < 1")
    assert has_gradient(problem) is depends
    if "backwards" not in name:  # Which has no derivative along a direction.
        assert of_a_derivative(signal) is depends
    other = vj.Problem("p", {"x": vj.Box(-1.0, 1.0)}, system, "always other < 1")
    assert has_gradient(other) is False


def test_features_that_jump_have_no_derivative():
    def system(features, key):
        return vj.Trace({"y": jnp.full(2, features["x"] * 1.0)}, dt=1.0)

    for domain in (vj.DiscreteBox(0, 3), vj.Categorical(0.5, 1.5)):
        space = {"x": domain, "more": vj.Box(0.0, 1.0)}
        assert not has_gradient(vj.Problem("p", space, system, "always y < 1"))
    assert has_gradient(vj.Problem("p", {"x": vj.Normal(0.0, 1.0)}, system, "always y < 1"))


def walks(noisy):
    """A walk that splits its key at every step, and draws from it where it is noisy."""

    def system(features, key):
        def step(carry, _):
            x, key = carry
            key, own = jax.random.split(key)
            return (x + noisy * jax.random.normal(own) if noisy else x + 1.0, key), x

        _, x = jax.lax.scan(step, (features["x"], key), None, length=4)
        return vj.Trace({"x": x}, dt=1.0)

    return system


def beside(features, key):
    return vj.Trace({"x": features["x"][None], "other": jax.random.normal(key)[None]}, dt=1.0)


def ends_at_random(features, key):
    x = jnp.broadcast_to(features["x"], 3)
    return vj.Trace({"x": x}, dt=1.0, valid=1 + jax.random.randint(key, (), 0, 2))


def on_the_host(features, seed=0):
    return vj.Trace({"x": np.array([features["x"]])}, dt=1.0)


@pytest.mark.parametrize(
    ("system", "depends"),
    [
        (walks(0), False),
        (walks(0.1), True),
        (beside, False),
        (ends_at_random, True),
        (vj.blackbox(on_the_host), False),
        (vj.blackbox(on_the_host, seeded=True), True),
    ],
    ids=["split", "drawn", "not monitored", "early end", "black box", "seeded black box"],
)
def test_a_verdict_depends_on_a_key_that_reaches_it(system, depends):
    problem = vj.Problem("walk", {"x": vj.Normal(0.0, 1.0)}, system, "always x > -3")
    assert depends_on_key(problem) is depends
