"""The same policy in two engines: what is planted is found, and nothing where there is nothing."""

import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.problem.problem import ProblemError


def policy(state):
    return -4.0 * state["x"] - 1.5 * state["v"]


def plant(drag=0.0, method="rk4", dt=0.05, steps=60, order=1, extra=None, name="plant"):
    """A mass on a spring under the policy; `order` says how equal terms are written."""

    def problem(policy):
        def flow(time, state, control, features):
            stiff = features["stiffness"] * state["x"]
            if order == 1:
                force = control - stiff - drag * state["v"] * jnp.abs(state["v"])
            else:
                force = -(stiff - control) - drag * state["v"] * jnp.abs(state["v"])
            return {"x": state["v"], "v": force / features["mass"]}

        system = vj.ode(
            flow,
            lambda features, key: {"x": features["x0"], "v": jnp.zeros_like(features["x0"])},
            controller=lambda time, state, features: policy(state),
            dt=dt,
            steps=steps,
            method=method,
        )
        space = {"x0": vj.Box(-1.0, 1.0), "stiffness": vj.Box(0.5, 2.0), "mass": vj.Box(0.5, 2.0)}
        return vj.Problem(name, {**space, **(extra or {})}, system, "always x > -0.4")

    return problem


def compared(one, other, **options):
    return vj.transfer(
        policy, one, other, samples=32, simulations=32, batch=32, progress=False, **options
    )


@pytest.mark.slow
def test_a_planted_difference_is_found(tmp_path):
    found = compared(plant(name="without drag"), plant(drag=0.5, name="with drag"))
    assert found.differs
    assert len(found.flips) > 0
    assert set(found.flips["violated_b"]) == {False}
    text = str(found)
    assert "the same policy in without drag and in with drag" in text
    assert "0 fail in with drag only" in text
    assert "in without drag only" in text
    # The start decides how far they part, and the drag acts from the first motion on.
    assert next(iter(found.influence)) == "x0"
    assert found.table["parted"].min() < 0.5
    searched = found.table["searched"]
    best = found.table.groupby(searched)["gap"].max()
    assert best[True] > best[False]
    assert "worse" not in text
    row, one, other = found.worst
    assert found.table["gap"].idxmax() == row
    assert not np.allclose(one.signals["x"], other.signals["x"], atol=1e-3)
    found.plot(tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 1000
    assert "<img" in found._repr_html_()
    assert found.rules()
    page = found.report(tmp_path / "t.html").read_text()
    assert "without drag and with drag differ: traces part in 64 of 64 pairs" in page
    assert "pairs with different verdicts:" in page


@pytest.mark.slow
def test_no_difference_where_terms_are_only_written_otherwise():
    found = compared(plant(), plant(order=2))
    assert not found.differs
    assert found.worst is None
    assert "no difference beyond rounding in 64 pairs" in str(found)
    assert found.table["gap"].max() < 1e-9


@pytest.mark.slow
def test_another_integrator_at_another_clock():
    found = compared(plant(), plant(method="euler", dt=0.025, steps=120))
    assert found.differs
    assert found.table["proper"].all()


PENDULUM = """
<mujoco>
  <option timestep="0.005" integrator="{integrator}"/>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 1 0" damping="0.1" armature="{armature}"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 -0.4" size="0.03"/>
    </body>
  </worldbody>
  <actuator><general joint="hinge" biastype="affine" biasprm="0 0 -{drag}"/></actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def pendulums():
    pytest.importorskip("mujoco")

    def problem(integrator="Euler", armature=0.0, drag=0.0):
        system = vj.mujoco(
            PENDULUM.format(integrator=integrator, armature=armature, drag=drag),
            duration=0.5,
            control_period=0.02,
            bind={"start": "joint/hinge/qpos"},
            controller=lambda time, state, features: -state.qpos[0],
            signals={"angle": "joint/hinge/qpos"},
            backend="native",
        )
        return vj.Problem("pendulum", {"start": vj.Box(-0.5, 0.5)}, system, "always angle < 9")

    def compared(one, other):
        a, b = problem(**one), problem(**other)
        return vj.transfer(None, a, b, samples=8, simulations=0, batch=8, progress=False)

    return compared


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"armature": 0.001}, "the models differ: dof_armature is [0.] in a and [0.001] in b"),
        ({"integrator": "RK4"}, "option/integrator is mjINT_EULER in a and mjINT_RK4 in b"),
        ({"integrator": "implicitfast", "drag": 0.1}, "mjINT_IMPLICITFAST in b"),
    ],
)
def test_another_integrator_or_armature_of_mujoco(pendulums, change, said):
    found = pendulums({"drag": change.get("drag", 0.0)}, change)
    assert found.differs
    assert said in str(found)


@pytest.mark.slow
def test_integrators_of_mujoco_that_are_one_where_only_joints_are_damped(pendulums):
    """MuJoCo's Euler treats the damping of joints implicitly."""
    found = pendulums({}, {"integrator": "implicitfast"})
    assert found.table["gap"].max() == 0.0
    assert "no difference beyond rounding" in str(found)
    assert "option/integrator is mjINT_EULER in a and mjINT_IMPLICITFAST in b" in str(found)


def test_what_is_wrong_is_said():
    with pytest.raises(TypeError, match=r"problem_b must be a Problem, or a function.*got int"):
        vj.transfer(policy, plant(), 3)
    with pytest.raises(ValueError, match="follows gradients"):
        vj.transfer(policy, plant(), plant(), search="gradient")
    other = plant()(policy)
    apart = vj.Problem("p", {"y": vj.Box(0, 1)}, lambda f, k: vj.Trace({"x": jnp.ones(3)}, dt=1.0),
                       "always x > 0")  # fmt: skip
    with pytest.raises(ProblemError, match="the problems have no varying feature in common"):
        vj.transfer(policy, other, apart)
