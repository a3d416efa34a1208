"""Each kind of fault in a loop of equations: against loops by hand, bit for bit when off."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons import faults
from verifai_jax.core.compute.jaxprs import programs_in
from verifai_jax.core.values.trace import Status

DT, STEPS = 0.1, 30
WINDOW = {"onset": vj.Box(-1, 4), "duration": vj.Box(0, 2)}
KEY = jax.random.key(3)

KINDS = {
    "delay": faults.Delay("x", seconds=vj.Box(0, 0.5), **WINDOW),
    "dropout": faults.Dropout("x", value=-2.0, **WINDOW),
    "freeze": faults.Freeze("x", **WINDOW),
    "bias": faults.Bias("x", offset=vj.Box(-1, 1), **WINDOW),
    "drift": faults.Drift("x", rate=vj.Box(0, 1), **WINDOW),
    "noise": faults.Noise("x", std=vj.Box(0, 1), **WINDOW),
    "spikes": faults.Spikes("x", height=vj.Box(0, 1), rate=5.0, **WINDOW),
    "quantisation": faults.Quantisation("x", step=vj.Box(0, 0.6), **WINDOW),
    "saturation": faults.Saturation("x", limit=vj.Box(0.2, 50), **WINDOW),
    "stuck": faults.Stuck("x", value=0.25, **WINDOW),
    "loss": faults.LossOfAuthority("x", loss=vj.Box(0, 1), **WINDOW),
    "held": faults.HeldAction("x", hold=vj.Box(0, 0.5), **WINDOW),
    "packets": faults.PacketLoss("x", loss=vj.Box(0, 1), **WINDOW),
    "jitter": faults.ClockJitter("x", jitter=vj.Box(0, 0.5), **WINDOW),
    "flip": faults.SignFlip("x", **WINDOW),
    "wrong": faults.WrongChannel("x", source="clock", **WINDOW),
    "lopsided": faults.Saturation(
        "x", limit=vj.Box(1.5, 50), lower=vj.Box(-50, 1.4), name="x_lopsided", **WINDOW
    ),
    "band": faults.DeadBand("x", width=vj.Box(0, 2), **WINDOW),
    "backlash": faults.Backlash("x", gap=vj.Box(0, 3), **WINDOW),
    "slow": faults.RateLimit("x", rate=vj.Box(0.5, 50), **WINDOW),
    "gain": faults.Gain("x", factor=vj.Box(1, 3), **WINDOW),
}
NO_KINDS = {"AtMost", "Fault", "Scale", "on_host"}
assert {type(fault).__name__ for fault in KINDS.values()} == {*faults.__all__} - NO_KINDS


def course(k):
    """What the sensor should read: a course without a symmetry."""
    return 1.0 + 0.3 * k - 0.012 * k * k


def plant():
    """A plant that moves by its clock alone, and whose controller hands out what it sees."""
    return vj.ode(
        lambda time, state, control, features: {"x": jnp.zeros(()), "clock": jnp.ones(())},
        lambda features, key: {"x": jnp.float32(course(0)), "clock": jnp.zeros(())},
        controller=lambda time, state, features: {"seen": state["x"], "push": features["push"]},
        update=lambda time, state, features: {**state, "x": course(jnp.round(time / DT))},
        dt=DT,
        steps=STEPS,
        signals=lambda time, state, control, features: {**state, **control},
    )


def problem():
    return vj.Problem(
        "course", {"push": vj.Box(-1, 1)}, plant(), "always seen <= 100", nominal={"push": 0.5}
    )


@pytest.fixture(scope="module")
def all_of_them():
    """All kinds in one program, each on a copy of the loop: only one of them acts at a time."""
    return problem().with_faults(*KINDS.values())


@pytest.fixture(scope="module")
def simulate(all_of_them):
    compiled = jax.jit(all_of_them.system)
    off = dict(all_of_them.nominal)

    def simulate(name=None, key=KEY, checked=True, **numbers):
        fault = KINDS.get(name)
        own = {} if fault is None else {fault.name: {**off[fault.name], **numbers}}
        space = all_of_them.space
        return compiled((space.coerce if checked else space.convert)({**off, **own}), key)

    return simulate


@pytest.fixture(scope="module")
def healthy():
    return jax.jit(plant())({"push": jnp.float32(0.5)}, KEY)


def same_bits(one, other):
    return all(
        np.asarray(one[name]).tobytes() == np.asarray(other[name]).tobytes()
        for name in other.signals
    )


def work(program):
    """Count the operations of a program, without those of loops that may have no pass."""
    return sum(
        1 + (0 if step.primitive.name == "while" else sum(map(work, programs_in(step))))
        for step in program.eqns
    )


@pytest.mark.thorough
def test_a_fault_that_is_off_in_a_whole_batch_is_a_loop_without_a_pass(all_of_them):
    def traced(problem, features):
        rows = jax.tree.map(lambda leaf: jnp.stack([jnp.asarray(leaf)] * 2), features)
        keys = jax.random.split(KEY)
        return work(jax.make_jaxpr(jax.vmap(problem.system))(rows, keys).jaxpr)

    off = all_of_them.space.coerce(all_of_them.nominal)
    alone = traced(problem(), {"push": off["push"]})
    # Without its arithmetic: the entries that pass, whether it acts, and the draw of its seed.
    assert traced(all_of_them, off) - alone < 32 * len(KINDS)


def severest(fault):
    wanted = {"onset": 0.5, "duration": 1.5}
    domains = fault.domains
    if fault.severity != "duration":
        domain = domains[fault.severity]
        wanted[fault.severity] = domain.low if fault.off == math.inf else domain.high
    return wanted


@pytest.mark.thorough
def test_nominal_is_no_fault_bit_for_bit(simulate, healthy):
    assert same_bits(simulate(), healthy)


@pytest.mark.thorough
@pytest.mark.parametrize("name", KINDS)
def test_severity_zero_and_onset_after_the_end_are_no_fault(simulate, healthy, name):
    fault, numbers = KINDS[name], severest(KINDS[name])
    assert not same_bits(simulate(name, **numbers), healthy)
    assert same_bits(simulate(name, **{**numbers, "onset": 3.5}), healthy)
    assert same_bits(simulate(name, **{**numbers, "duration": 0.0}), healthy)
    if fault.severity != "duration":
        off = 50.0 if fault.off == math.inf else fault.off
        assert same_bits(simulate(name, **{**numbers, fault.severity: off}), healthy)


def by_hand(name, good, begin, end):
    """What is seen, sample by sample, of the kinds that draw nothing."""
    seen, before, last = [], None, good[0]
    for k, x in enumerate(good):
        inside = begin <= k < end
        bad = {
            "delay": lambda k=k: good[max(0, k - 3)],
            "dropout": lambda: -2.0,
            "freeze": lambda x=x, before=before: x if before is None else before,
            "bias": lambda x=x: x + 0.7,
            "drift": lambda x=x, k=k: x + 0.8 * DT * (k - begin),
            "quantisation": lambda x=x: round(x / 0.5) * 0.5,
            "saturation": lambda x=x: max(-1.3, min(1.3, x)),
            "stuck": lambda: 0.25,
            "loss": lambda x=x: x * 0.6,
            "held": lambda k=k: good[begin + (k - begin) // 4 * 4],
            "flip": lambda x=x: -x,
            "wrong": lambda k=k: k * DT,
            "lopsided": lambda x=x: 1.6 if x > 1.6 else -0.2 if x < -0.2 else x,
            "band": lambda x=x: x - 1.2 if x > 1.2 else x + 1.2 if x < -1.2 else 0.0,
            "backlash": lambda x=x, last=last: (
                x - 0.6 if x - last > 0.6 else x + 0.6 if last - x > 0.6 else last
            ),
            "slow": lambda x=x, last=last: last + math.copysign(min(abs(x - last), 0.09), x - last),
            "gain": lambda x=x: 2.5 * x,
        }[name]
        last = bad() if inside else x
        seen.append(last)
        before = before if inside else x
    return seen


NUMBERS = {
    "delay": {"seconds": 0.31}, "bias": {"offset": 0.7}, "drift": {"rate": 0.8},
    "quantisation": {"step": 0.5}, "saturation": {"limit": 1.3}, "loss": {"loss": 0.4},
    "held": {"hold": 0.4}, "lopsided": {"limit": 1.6, "lower": -0.2}, "band": {"width": 1.2},
    "backlash": {"gap": 1.2}, "slow": {"rate": 0.9}, "gain": {"factor": 2.5},
}  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize("name", sorted({*KINDS} - {"noise", "spikes", "packets", "jitter"}))
def test_against_a_loop_by_hand(simulate, name):
    good = [float(course(k)) for k in range(STEPS + 1)]
    trace = simulate(name, onset=0.7, duration=1.1, **NUMBERS.get(name, {}))
    expected = by_hand(name, good, 7, 18)
    np.testing.assert_allclose(trace["seen"], expected, atol=1e-5)
    np.testing.assert_allclose(trace["x"], good, atol=1e-5)


@pytest.mark.parametrize(
    ("kind", "number"),
    [("lopsided", {"limit": 2.0, "lower": -0.25}), ("band", {"width": 1.1}),
     ("backlash", {"gap": 1.7}), ("slow", {"rate": 6.0}), ("gain", {"factor": 1.8})],
)  # fmt: skip
def test_faults_of_mechanics_on_random_values_against_a_loop_in_numpy(kind, number):
    """With values of both signs that turn often, and two entries."""
    rng = np.random.default_rng(5)
    good = np.cumsum(rng.normal(size=(200, 2)), axis=0)
    good[:, 1] *= -0.5
    made = {
        "lopsided": faults.Saturation, "band": faults.DeadBand, "backlash": faults.Backlash,
        "slow": faults.RateLimit, "gain": faults.Gain,
    }[kind]("observation", **number, onset=3.0, duration=12.0)  # fmt: skip
    loop, expected, last = faults.on_host([made], {}, period=0.1), [], None
    read = [loop.observation(0.1 * k, value) for k, value in enumerate(good)]
    for k, value in enumerate(good):
        if 30 <= k < 150 and kind == "lopsided":
            last = np.minimum(np.maximum(value, -0.25), 2.0)
        elif 30 <= k < 150 and kind == "band":
            last = np.sign(value) * np.maximum(np.abs(value) - 1.1, 0)
        elif 30 <= k < 150 and kind == "backlash":
            last = np.minimum(np.maximum(last, value - 0.85), value + 0.85)
        elif 30 <= k < 150 and kind == "slow":
            last = last + np.minimum(np.maximum(value - last, -0.6), 0.6)
        elif 30 <= k < 150:
            last = 1.8 * value
        else:
            last = value
        expected.append(last)
    np.testing.assert_allclose(read, expected, atol=1e-9)


def test_a_lower_limit_above_the_upper_one_is_refused():
    with pytest.raises(ValueError, match=r"lower of Saturation must not exceed limit, 1.0; got 2"):
        faults.Saturation("x", limit=1.0, lower=2.0)


@pytest.mark.thorough
def test_a_negative_onset_is_a_fault_that_began_before(simulate):
    seen = np.asarray(simulate("stuck", onset=-0.5, duration=1.0)["seen"])
    np.testing.assert_array_equal(seen == 0.25, np.arange(STEPS + 1) < 5)
    frozen = np.asarray(simulate("freeze", onset=-0.5, duration=1.0)["seen"])
    np.testing.assert_allclose(frozen[:5], course(0))


@pytest.mark.thorough
def test_nan_is_an_error_of_the_row_and_no_counterexample(simulate, all_of_them):
    for name in ("onset", "duration", "offset"):
        numbers = {"onset": 0.5, "duration": 1.0, "offset": 0.5, name: math.nan}
        with pytest.raises(ValueError, match=f"x_bias.{name} must lie in"):
            simulate("bias", **numbers)
        trace = simulate("bias", checked=False, **numbers)
        assert int(trace.status) == Status.ERROR
    reason = all_of_them.system.why_error({"x_bias.offset": math.nan})
    assert reason == "offset of fault 'x_bias' of this system must be a number; got nan"


@pytest.mark.thorough
def test_chance_is_of_the_row_and_of_the_name(simulate, all_of_them):
    assert all_of_them.draws()
    assert not problem().with_faults(KINDS["bias"]).draws()
    numbers = {"onset": 0.0, "duration": 2.0}
    once = simulate("noise", std=0.5, **numbers)
    assert same_bits(simulate("noise", std=0.5, **numbers), once)
    assert not same_bits(simulate("noise", key=jax.random.key(4), std=0.5, **numbers), once)
    # Whatever other faults there are.
    alone = problem().with_faults(KINDS["noise"])
    again = jax.jit(alone.system)(
        alone.space.coerce({"push": 0.5, "x_noise": {"std": 0.5, **numbers}}), KEY
    )
    np.testing.assert_allclose(again["seen"], once["seen"], rtol=1e-4)
    lost = np.asarray(simulate("packets", loss=0.5, **numbers)["seen"])[:20]
    repeated = np.mean(lost[1:] == lost[:-1])
    assert 0.15 < repeated < 0.85
    late = np.asarray(simulate("jitter", jitter=0.5, **numbers)["seen"])[:20]
    earlier = np.array([course(k) for k in range(20)])
    assert np.abs(late[:, None] - earlier).min(axis=1).max() < 1e-5
    assert np.abs(late - earlier).max() > 0.1
    spikes = np.asarray(simulate("spikes", height=1.0, **numbers)["seen"])
    off = np.abs(spikes - [course(k) for k in range(STEPS + 1)])[:20]
    assert set(np.round(off, 3)) == {0.0, 1.0}


@pytest.mark.thorough
def test_faults_of_one_channel_apply_in_their_order():
    stuck = faults.Stuck("x", value=2.0)
    bias = faults.Bias("observation.x", offset=0.5)
    for order, seen in (((stuck, bias), 2.5), ((bias, stuck), 2.0)):
        trace = jax.jit(problem().with_faults(*order).system)({"push": jnp.float32(0)}, KEY)
        np.testing.assert_allclose(trace["seen"], seen)
    one, other = (problem().with_faults(each) for each in (stuck, bias))
    assert one.with_faults(bias).system.links == problem().with_faults(stuck, bias).system.links
    assert other.space == problem().space  # Nothing of it varies.


@pytest.mark.slow
def test_derivatives_are_those_of_the_line_between_two_samples(all_of_them):
    """Onset and duration move in whole samples: only over a few of them is there a slope."""
    weight = jnp.linspace(1, 2, STEPS + 1)
    off = all_of_them.nominal

    def total(name, numbers):
        fault = KINDS[name]
        features = {**off, fault.name: {**off[fault.name], **numbers}}
        trace = all_of_them.system(all_of_them.space.convert(features), KEY)
        return jnp.sum(weight * trace["seen"])

    for name, numbers in (
        ("bias", {"offset": 0.4, "onset": 0.83, "duration": 0.95}),
        ("dropout", {"onset": 0.83, "duration": 0.95}),
        ("drift", {"rate": 0.4, "onset": 0.83, "duration": 0.95}),
        ("saturation", {"limit": 1.4, "onset": 0.83, "duration": 0.95}),
        ("loss", {"loss": 0.4, "onset": 0.83, "duration": 0.95}),
    ):
        numbers = {n: jnp.float32(v) for n, v in numbers.items()}
        value = jax.jit(lambda numbers, name=name: total(name, numbers))
        slopes = jax.jit(jax.grad(lambda numbers, name=name: total(name, numbers)))(numbers)
        for number in numbers:
            # Two samples each way: the mean slope of a course that is nearly straight.
            step = 0.2 if number in ("onset", "duration") else 1e-2
            high, low = (
                value({**numbers, number: numbers[number] + sign * step}) for sign in (1, -1)
            )
            measured = (high - low) / (2 * step)
            assert float(slopes[number]) == pytest.approx(float(measured), rel=0.1, abs=0.5)
    # Off, a fault is still known to grow worse by its duration.
    numbers = {"onset": jnp.float32(1.0), "duration": jnp.float32(0.0)}
    assert float(jax.grad(lambda n: total("dropout", n))(numbers)["duration"]) != 0
