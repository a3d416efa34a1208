"""Certificates of policies whose failure probability is known: `y = x - t` fails where x > t."""

import itertools
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons.estimation.certification import certify
from verifai_jax.addons.estimation.certification import simulators as programs
from verifai_jax.addons.estimation.certification.blocks import Blocks
from verifai_jax.addons.estimation.certification.policy_groups import digest, group_policies, padded
from verifai_jax.addons.rl import Continuous, Policy
from verifai_jax.core.messages.errors import UnknownNameError

X = vj.FeatureSpace({"x": vj.Box(0.0, 1.0), "z": vj.Box(0.0, 1.0)})


def threshold(t, width=4):
    """A policy whose output is `x - t`, by a hidden layer of some width."""
    hidden = np.zeros((1, width), np.float32)
    hidden[0, 0] = 1.0
    out = np.zeros((width, 1), np.float32)
    out[0, 0] = 1.0
    layers = ((hidden, np.zeros(width, np.float32)), (out, np.array([-t], np.float32)))
    return Policy(layers, None, None, None, Continuous(-10.0, 10.0), activation="relu")


def simulated(policy, nonfinite_above=2.0):
    def system(features, key):
        (y,) = policy(features["x"][None])
        y = jnp.where(features["z"] > nonfinite_above, jnp.nan, y)
        return vj.Trace({"y": jnp.stack([y, y - 1.0])}, dt=1.0)

    return system


def problem_of(policy):
    return vj.Problem("threshold", X, simulated(policy), "always y <= 0", nominal={"x": 0, "z": 0})


RATES = (0.0, 0.02, 0.3, 0.0, 1.0)
THRESHOLDS = (2.0, 0.98, 0.7, 1.5, -1.0)
POLICIES = [threshold(t, w) for t, w in zip(THRESHOLDS, (4, 7, 64, 4, 1), strict=True)]


@pytest.fixture(scope="module")
def memo():
    return {}


@pytest.fixture(scope="module")
def certificates(memo):
    def remember(key, compute):
        if key not in memo:
            memo[key] = compute()
        return memo[key]

    return certify(
        problem_of,
        POLICIES,
        p=0.1,
        certification=vj.Certification(samples=128),
        seed=3,
        remember=remember,
    )


@pytest.mark.proves
def test_verdicts_of_known_rates(certificates):
    verdicts = [row.verdict for row in certificates.rows]
    assert verdicts == ["safe@0.1", "safe@0.1", "unsafe", "safe@0.1", "unsafe"]
    assert certificates.safe == (0, 1, 3)
    assert certificates.unsafe == (2, 4)
    for row, rate in zip(certificates.rows, RATES, strict=True):
        assert row.rate.low <= rate <= row.rate.high
        assert row.simulations >= 128
    # Equally safe; the one with more room in the attack is named.
    assert certificates.safest == 0
    assert certificates.stopped == "decided"


@pytest.mark.slow
@pytest.mark.parametrize("traced", [True, False])
def test_certificates_from_workers_are_the_same(traced):
    policies = POLICIES if traced else [lambda x, t=t: x - t for t in THRESHOLDS]
    options = {"p": 0.1, "seed": 3, "certification": vj.Certification(64, attack_simulations=64)}
    here = certify(problem_of, policies, **options)
    with ThreadPoolExecutor(2) as executor:
        there = certify(problem_of, policies, **options, run_on=vj.RunOn(executor=executor))
    assert here.safest == there.safest
    for one, other in zip(here.rows, there.rows, strict=True):
        assert (one.failures, one.simulations, one.rate) == (
            other.failures, other.simulations, other.rate,
        )  # fmt: skip
        assert one.worst_robustness == other.worst_robustness
        np.testing.assert_array_equal(one.counterexamples["rho"], other.counterexamples["rho"])


@pytest.mark.thorough
def test_failures_are_those_of_the_samples(certificates):
    pieces = Blocks(problem_of, POLICIES, seed=3, lanes=64)
    for row, t in zip(certificates.rows, THRESHOLDS, strict=True):
        x = np.concatenate([pieces.points(b)[:, 0] for b in range(row.simulations // 64)])
        assert row.failures == np.sum(x > np.float32(t))


@pytest.mark.thorough
def test_the_attack_meets_what_samples_miss(certificates):
    for row, t in zip(certificates.rows, THRESHOLDS, strict=True):
        # The corner x = 1 is the worst there is.
        assert row.worst_robustness == pytest.approx(t - 1.0, abs=1e-3)
        assert row.worst_features["x"] == pytest.approx(1.0, abs=1e-3)
        assert row.attacks == 256
    found = certificates.counterexamples(1)
    assert list(found.columns) == ["x", "z", "rho"]
    assert len(found) == certificates[1].failures + certificates[1].attack_failures
    np.testing.assert_allclose(found["rho"], 0.98 - found["x"], atol=1e-6)
    assert found["rho"].is_monotonic_increasing


@pytest.mark.thorough
def test_a_memo_holds_all_that_is_needed(certificates, memo):
    def recalled(key, compute):
        return memo[key]

    again = certify(
        problem_of,
        POLICIES,
        p=0.1,
        certification=vj.Certification(samples=128),
        seed=3,
        remember=recalled,
    )
    assert again.table.equals(certificates.table)
    # A part of it is enough: the others are simulated as they were.
    random = np.random.default_rng(0)
    some = {key: memo[key] for key in memo if random.random() < 0.5}

    def partly(key, compute):
        return some[key] if key in some else compute()

    again = certify(
        problem_of,
        POLICIES,
        p=0.1,
        certification=vj.Certification(samples=128),
        seed=3,
        remember=partly,
    )
    assert again.table.equals(certificates.table)


@pytest.mark.thorough
def test_order_company_and_devices_change_nothing(certificates):
    order = [2, 0, 4, 3, 1]
    other = certify(
        problem_of, [POLICIES[i] for i in order], p=0.1,
        certification=vj.Certification(samples=128), seed=3, devices=jax.devices()[:1],
    )  # fmt: skip
    table = other.table.assign(policy=order).sort_values("policy").reset_index(drop=True)
    assert table.equals(certificates.table)
    assert order[other.safest] == certificates.safest


@pytest.mark.thorough
def test_an_accelerator_works_on_all_blocks_at_once(certificates, monkeypatch):
    monkeypatch.setattr(programs, "_one_by_one", lambda devices: False)
    monkeypatch.setattr(programs, "MAX_BLOCKS", 4)
    other = certify(
        lambda policy: problem_of(policy), POLICIES, p=0.1, seed=3,
        certification=vj.Certification(samples=128, attack_simulations=0),
    )  # fmt: skip
    columns = ["failures", "not_finite"]
    first = other.table[columns][other.table["simulations"] == 128]
    expected = certificates.table[columns].loc[first.index]
    assert len(first) >= 2
    assert first.equals(expected)


def test_policies_of_one_structure_share_a_program():
    (one,) = group_policies(POLICIES)
    assert one.numbers == (0, 1, 2, 3, 4)
    wider = group_policies([*POLICIES, threshold(0.5, 65), threshold(0.5, 128)])
    assert [family.numbers for family in wider] == [(0, 1, 2, 3, 4), (5, 6)]
    tanh = Policy(
        *(getattr(POLICIES[0], n) for n in ("layers", "mean", "scale", "log_std", "action"))
    )
    assert len(group_policies([POLICIES[0], tanh])) == 2


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_padding_changes_no_action(activation):
    random = np.random.default_rng(0)
    sizes = (3, 20, 33, 2)
    layers = tuple(
        (random.normal(size=(a, b)).astype(np.float32), random.normal(size=b).astype(np.float32))
        for a, b in itertools.pairwise(sizes)
    )
    policy = Policy(layers, None, None, None, Continuous(-1.0, 1.0, 2), activation=activation)
    wide = padded(policy)
    assert [weight.shape for weight, _ in wide.layers] == [(3, 64), (64, 64), (64, 2)]
    x = random.normal(size=(50, 3)).astype(np.float32)
    np.testing.assert_allclose(jax.vmap(wide)(x), jax.vmap(policy)(x), rtol=1e-5, atol=1e-5)


def test_a_digest_is_of_numbers_and_structure():
    assert digest(threshold(0.5)) == digest(threshold(0.5))
    assert digest(threshold(0.5)) != digest(threshold(np.nextafter(np.float32(0.5), 1)))
    assert digest(threshold(0.5, 4)) != digest(threshold(0.5, 5))


@pytest.mark.thorough
def test_at_exactly_zero_the_comparator_decides():
    zero = [jax.tree.map(np.zeros_like, threshold(0.0))]
    once = vj.Certification(samples=64, budget=64, attack_simulations=0)
    only = {"certification": once}
    assert certify(problem_of, zero, **only)[0].failures == 0

    def strictly(policy):
        return vj.Problem("flat", X, simulated(policy), "always y < 0")

    breaks = certify(strictly, zero, **only)
    assert breaks[0].failures == 64
    assert breaks[0].worst_robustness == 0.0


@pytest.mark.thorough
def test_without_a_verdict_is_no_pass():
    def problem_of(policy):
        return vj.Problem("nan", X, simulated(policy, 0.75), "always y <= 0")

    found = certify(
        problem_of,
        [threshold(2.0), threshold(0.5)],
        certification=vj.Certification(samples=256, attack_simulations=0),
        p=0.1,
    )
    for row in found.rows:
        assert 256 * 0.15 < row.not_finite < row.simulations * 0.35
        assert row.rate.failures == row.failures + row.not_finite
        assert row.verdict == "unsafe"
    assert found[0].failures == 0
    assert "gave no verdict" in str(found)


def test_only_what_the_constraint_accepts_is_simulated():
    def problem_of(policy):
        space = vj.FeatureSpace(dict(X.domains), where=lambda f: f["x"] <= 0.5)
        return vj.Problem("half", space, simulated(policy), "always y <= 0")

    found = certify(
        problem_of,
        [threshold(0.25), threshold(0.6)],
        certification=vj.Certification(samples=256),
        p=0.1,
    )
    assert found[0].rate.low < 0.5 < found[0].rate.high
    assert found[1].failures == found[1].attack_failures == 0
    assert found.counterexamples(0)["x"].max() <= 0.5


def reference(policy):
    return np.array([-float(policy.layers[1][1][0])])


def untraceable(policy):
    t = float(reference(policy)[0])

    def system(features, key):
        return vj.Trace({"y": jnp.stack([features["x"] - t, features["x"] - t - 1])}, dt=1.0)

    return vj.Problem("threshold", X, system, "always y <= 0")


def outside(policy):
    t = float(reference(policy)[0])

    def system(features):
        if t > 0.75 and features["x"] > 0.9:
            raise RuntimeError("out of the world")
        return vj.Trace({"y": np.array([features["x"] - t, features["x"] - t - 1])}, dt=1.0)

    return vj.Problem("threshold", X, vj.blackbox(system), "always y <= 0")


@pytest.mark.thorough
def test_what_jax_cannot_trace_is_simulated_policy_by_policy():
    some = [POLICIES[2]]
    once = vj.Certification(samples=64, budget=64, attack_simulations=64)
    options = {"p": 0.05, "certification": once}
    expected = certify(problem_of, some, **options).table
    for make, told in [(untraceable, "compiled one by one: policy 0; JAX"), (outside, None)]:
        found = certify(make, some, **options)
        assert found.table["failures"].tolist() == expected["failures"].tolist()
        assert [note[: len(told)] for note in found.notes] == [told] if told else not found.notes


def test_what_a_black_box_raises_is_told():
    found = certify(
        outside,
        [POLICIES[1]],
        p=0.05,
        certification=vj.Certification(samples=64, budget=64, attack_simulations=0),
    )
    assert 0 < found[0].not_finite < 20
    (note,) = found.notes
    assert note.startswith("a simulation of policy 0 raised RuntimeError: out of the world (")
    assert note.endswith(", in system)")


def test_interrupted_it_says_what_is_known():
    def progress(done, total, text):
        if text.startswith("sampling") and done >= 4 * 256 + 200:
            raise KeyboardInterrupt

    found = certify(
        problem_of,
        POLICIES[:4],
        p=0.1,
        certification=vj.Certification(samples=128),
        seed=3,
        progress=progress,
    )
    assert found.stopped == "interrupted"
    assert [row.simulations for row in found.rows] == [128, 128, 0, 0]
    assert found[3].verdict == "undecided"
    assert found[3].rate is None
    assert found.safest is None
    assert "policy 3: undecided, no sample yet" in str(found)


def test_progress_counts_simulations():
    seen = []
    found = certify(
        problem_of, POLICIES[:2], p=0.1,
        certification=vj.Certification(samples=128, attack_simulations=64),
        progress=lambda done, total, text: seen.append((done, total, text)),
    )  # fmt: skip
    assert [done for done, _, _ in seen] == sorted(done for done, _, _ in seen)
    assert seen[0] == (64, 2 * 64 + found.budget, "attacking")
    assert seen[-1][0] == found.simulations + found.attacks
    assert "undecided" in seen[-1][2]


def test_it_reads_well(certificates):
    text = str(certificates)
    assert text.startswith(
        "certificates of 5 policies for threshold: 3 safe@0.1, 2 unsafe, 0 undecided "
        "(all are right with 95 %)\n  safest: policy 0, "
    )
    assert "the same number for every policy would be" in text
    assert str(certificates[4]).startswith("policy 4: unsafe, 128 of 128 fail, between 9")


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"p": 0}, "p must lie between 0 and 1; got 0"),
        ({"seed": -1}, "seed must be an integer of at least 0; got -1"),
        (
            {"certification": vj.Certification(budget=100)},
            "5 policies with 512 samples each need a budget of at least 2560",
        ),
        (
            {"certification": vj.Certification(attack="gradient")},
            "attack 'gradient' follows gradients",
        ),
        ({"certification": vj.Certification(attack="portfolio")}, "use one of uniform, halton"),
        ({"tie": 2}, "tie must be in \\[0, 1\\); got 2"),
    ],
)
def test_what_cannot_be_certified_is_refused(options, told):
    with pytest.raises(ValueError, match=told):
        certify(problem_of, POLICIES, **options)


def test_misspelt_names_get_the_nearest():
    with pytest.raises(UnknownNameError, match="did you mean 'certification'"):
        certify(problem_of, POLICIES, certificaton=0.9)
    with pytest.raises(UnknownNameError, match="did you mean 'cross_entropy'"):
        certify(problem_of, POLICIES, certification=vj.Certification(attack="cross_entopy"))


def test_problems_that_do_not_fit():
    with pytest.raises(ValueError, match="there is no policy to certify"):
        certify(problem_of, [])
    with pytest.raises(ValueError, match="the trace has no signal 'speed'") as raised:
        certify(lambda policy: vj.Problem("s", X, simulated(policy), "always speed < 1"), POLICIES)
    assert raised.value.__notes__[-1:] == ["while checking the problem of policy 0"]
    with pytest.raises(TypeError, match="problem_of must return a Problem for a policy"):
        certify(simulated, POLICIES)

    def by_width(policy):
        width = len(policy.layers[1][0])
        space = X if width <= 64 else vj.FeatureSpace({"x": vj.Box(0.0, 2.0)})
        return vj.Problem("s", space, lambda f, key: vj.Trace({"y": f["x"][None]}, dt=1.0), "y < 1")

    with pytest.raises(ValueError, match=r"the same features and formulas.*those of policy 1"):
        certify(by_width, [threshold(0.5), threshold(0.5, 100)])


@pytest.mark.thorough
def test_the_search_for_safe_policies_spends_little_on_others(certificates):
    found = certify(
        problem_of, POLICIES, p=0.1, certification=vj.Certification(samples=128), seed=3,
        only_safe=True,
    )  # fmt: skip
    assert [row.verdict for row in found.rows] == [row.verdict for row in certificates.rows]
    assert found.safe == (0, 1, 3)
    for row, whole, rate in zip(found.rows, certificates.rows, RATES, strict=True):
        # Fewer samples of the same stream; the attack ends with the block that fails first.
        assert row.simulations <= whole.simulations
        assert row.rate.low <= rate <= row.rate.high
        assert (row.attacks == 256) == (row.attack_failures == 0)
    assert max(found[i].simulations for i in found.unsafe) <= 128
    assert [found[i].attacks for i in found.unsafe] == [64, 64]
