"""MuJoCo Warp on its CPU device against MuJoCo in C: cart-pole, all bindings, contacts, refusals.

It is an extra of 400 MB that the test extra leaves out, so most of these tests run where it is
installed. Kernels take a minute to compile, once for a machine.
"""

import sys
from typing import Any

import jax
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons.simulators.mujoco.system import mujoco as model
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.testing import check_system

mujoco = pytest.importorskip("mujoco")
BALLS = """<mujoco><option timestep="0.005" {option}/><worldbody>
<geom name="floor" type="plane" size="5 5 .1"/>
<geom name="step" type="box" size=".3 1 .05" pos=".6 0 .05"/>
<body name="box" pos="0 0 .3"><freejoint name="box"/>
  <geom name="box" type="box" size=".1 .1 .1"/></body>
<body name="ball" pos=".2 0 .7"><freejoint name="ball"/>
  <geom name="ball" type="sphere" size=".1"/></body>
</worldbody>{more}</mujoco>"""
EXACT = '<option><flag diagexact="enable"/></option>'
SIGNALS = {
    "box": "joint/box/qpos[0:3]", "ball": "joint/ball/qpos[0:3]", "on": "contact/floor/ball",
    "step": "geom/step/xpos",
}  # fmt: skip
TIMES = {"duration": 0.4, "control_period": 0.02}


def balls(option="", more="", **options):
    bind = {"v": "joint/ball/qvel[0]", "step": "geom/step/pos[0]", "weight": "body/ball/mass"}
    text = BALLS.format(option=option, more=more)
    return model(text, **{"signals": SIGNALS, "bind": bind, **TIMES, **options})


# The last row is lost at once.
ROWS = {
    "v": np.array([0.0, 0.5, 1.0, 2.0, -1.0, 1e12], np.float32),
    "step": np.array([0.6, 0.45, 0.8, 0.5, 0.6, 0.6], np.float32),
    "weight": np.array([4.0, 1.0, 2.0, 4.0, 8.0, 4.0], np.float32),
}
KEYS = jax.random.split(jax.random.key(0), 6)


def rolled(system) -> Any:
    return system.simulate_batch(ROWS, KEYS)


def close(here, there, atol):
    """Compare traces of two engines, by the largest value of each signal."""
    np.testing.assert_array_equal(here.status, there.status)
    fine = np.asarray(there.status) == vj.Status.OK
    for name, wanted in there.signals.items():
        wanted, scale = wanted[fine], max(1.0, float(np.abs(wanted[fine]).max()))
        got = here.signals[name][fine]
        np.testing.assert_allclose(got, wanted, atol=atol * scale, err_msg=name)


@pytest.mark.slow
class TestAgainstC:
    @pytest.fixture(autouse=True)
    def warp(self):
        pytest.importorskip("mujoco_warp", reason="pip install 'verifai_jax[warp]'")

    def test_cart_pole(self):
        from test_mujoco import KEYS, loop, rows  # pyright: ignore[reportMissingImports]

        both = loop()
        here = both.with_backend("warp").simulate_batch(rows(), KEYS)
        there = both.with_backend("native").simulate_batch(rows(), KEYS)
        np.testing.assert_array_equal(here.valid, there.valid)
        close(here, there, 2e-5)
        finer = both.with_backend("warp").refined(2).simulate_batch(rows(), KEYS)
        close(finer, both.with_backend("native").refined(2).simulate_batch(rows(), KEYS), 2e-5)

    def test_the_contract_of_systems(self):
        space = vj.FeatureSpace(
            {"v": vj.Box(-1, 2), "step": vj.Box(0.4, 0.8), "weight": vj.Box(1, 8)}
        )
        check_system(balls(backend="warp"), space, tolerance=0.0)

    def test_every_kind_of_feature(self):
        from test_mujoco_parity import (  # pyright: ignore[reportMissingImports]
            rows_and_keys,
            system,
        )

        rows, keys = rows_and_keys()
        here, there = (
            system().with_backend(name).simulate_batch(rows, keys) for name in ("warp", "native")
        )
        close(here, there, 2e-3)

    def test_contacts_and_fixed_geoms_that_features_move(self):
        here, there = (rolled(balls(backend=b)) for b in ("warp", "native"))
        np.testing.assert_array_equal(here.signals["step"][:, 0, 0], ROWS["step"])
        assert here.signals["on"].max() == 1
        close(here, there, 1e-5)
        assert here.status.tolist() == [vj.Status.OK] * 5 + [vj.Status.NONFINITE]

    def test_contacts_that_do_not_fit_are_computed_again_with_more_room(self, monkeypatch):
        from verifai_jax.addons.simulators.mujoco.warp_rollout import WarpBatch

        wanted, made, old = rolled(balls(backend="warp")), [], WarpBatch._make

        def small(self):
            self.capacity = self.capacity or {"nconmax": 1, "njmax": 4}
            made.append(dict(self.capacity))
            return old(self)

        monkeypatch.setattr(WarpBatch, "_make", small)
        close(rolled(balls(backend="warp")), wanted, 0.0)
        assert made[-1]["njmax"] > 4

    def test_a_search_without_gradients_finds_and_confirms_a_failure(self):
        space = vj.FeatureSpace({"v": vj.Box(0, 2)})
        system = balls(bind={"v": "joint/ball/qvel[0]"})
        problem = vj.Problem("roll", space, system, "always ball[0] < 0.5")
        options = {"budget": 16, "batch": 16, "progress": False}
        run, there = (
            vj.falsify(problem, "uniform", run_on=vj.RunOn(backend=backend), **options)
            for backend in ("warp", "native")
        )
        assert run.backend == "warp"
        failing = run.table.counterexamples
        assert 0 < len(failing) == len(there.table.counterexamples) < 16
        np.testing.assert_allclose(run.table.all["rho"], there.table.all["rho"], atol=1e-5)
        assert run.replay(int(failing.index[0])).finding == ""
        with pytest.raises(ValueError, match="or the backend 'mjx', which has gradients"):
            vj.falsify(problem, "descent", run_on=vj.RunOn(backend="warp"), **options)

    @pytest.mark.parametrize(
        ("options", "said"),
        [
            ({"option": 'solver="PGS"'}, "mjSOL_PGS is unsupported"),
            ({"option": 'noslip_iterations="3" integrator="discrete"'}, "noslip solver not impl"),
            ({"more": EXACT}, "mjENBL_DIAGEXACT is unsupported; backend 'native' does"),
        ],
    )
    def test_what_it_lacks_is_named_before_anything_runs(self, options, said):
        with pytest.raises(ValueError, match=f"'warp' is not possible: MuJoCo Warp does.*{said}"):
            balls(**options, backend="warp")


class TestWithoutIt:
    def test_the_error_names_the_extra(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "warp", None)
        monkeypatch.setitem(sys.modules, "mujoco_warp", None)
        with pytest.raises(ValueError, match=r"pip install 'verifai_jax\[warp\]'"):
            balls(backend="warp")
        assert balls().backends == ("native", "mjx")

    def test_it_is_never_chosen_for_a_run(self):
        assert "warp" not in balls().backends
        with pytest.raises(UnknownNameError, match="unknown backend 'wrap'; did you mean 'warp'"):
            balls(backend="wrap")
