"""Names, derivatives, systems and errors of Scenic programs."""

import math
import re
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons.scenic import ProgramError
from verifai_jax.core.messages.errors import MissingExtra

GALLERY = Path(__file__).parent / "gallery"


def test_without_scenic_one_line_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "scenic", None)
    with pytest.raises(MissingExtra, match=r"pip install 'verifai_jax\[scenic\]'"):
        vj.scenic("ego = new Object at Range(0, 1) @ 0")


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")
@pytest.mark.usefixtures("installed")
class TestWithScenic:
    @pytest.mark.slow
    def test_names_are_those_of_the_program(self):
        program = vj.scenic(GALLERY / "cones.scenic")
        assert program.compiled
        assert program.seeded == ()
        assert program.by_scenic == {}
        columns = program.space.columns
        assert columns[:5] == (
            *("ego.position.x", "ego.position.y", "ego.heading", "ego.speed", "cone1.offset.y"),
        )
        assert {"cone1.heading", "broken.color", "param.brightness", "param.hour"} <= {*columns}
        assert program.space["param.hour"] == vj.DiscreteBox(6, 20)
        assert program.space["broken.color"] == vj.Categorical("red", "blue", "white")
        assert set(program.objects) == {"ego", "cone1", "cone2", "cone3", "broken", "params"}

    @pytest.mark.slow
    def test_gradients_are_those_of_finite_differences(self):
        program = vj.scenic(GALLERY / "cones.scenic")

        def sizes(u):
            scene = program.scenes(program.space.unflatten(u))
            return jnp.sum(jnp.stack([scene["broken"]["x"], scene["broken"]["y"]]) ** 2)

        u = jnp.asarray(np.random.default_rng(0).uniform(0.2, 0.8, program.space.dim), jnp.float32)
        gradient = np.asarray(jax.jit(jax.grad(sizes))(u))
        continuous = np.flatnonzero(np.array(program.space.levels) == 0)
        difference = jax.jit(jax.vmap(sizes))
        steps = np.eye(program.space.dim, dtype=np.float32)[continuous] * 2e-3
        measured = np.asarray(difference(u + steps) - difference(u - steps)) / 4e-3
        assert np.any(np.abs(gradient) > 1)
        np.testing.assert_allclose(gradient[continuous], measured, rtol=0.02, atol=0.5)

    def test_what_has_no_inverse_or_meaning_is_named(self):
        mutated = vj.scenic(GALLERY / "mutated.scenic")
        assert mutated.seeded == ("mutation of ego", "mutation of other")
        assert "seed" in mutated.space.columns
        assert "seeded: mutation of ego" in mutated.describe()
        assert mutated.in_python["other.x"] == "mutation of other"
        required = vj.scenic(GALLERY / "python_require.scenic")
        assert list(required.by_scenic) == ["require on line 9"]
        assert "crowded" in required.by_scenic["require on line 9"]
        assert required.compiled

    def test_the_same_seed_gives_the_same_mutation(self):
        program = vj.scenic(GALLERY / "mutated.scenic")
        features = {"other.position.x": 6.0, "other.heading": 3.0, "seed": 0.25}
        one, other = program.scene(features), program.scene(features)
        assert one.objects[1].position == other.objects[1].position
        moved = program.scene({**features, "seed": 0.5})
        assert moved.objects[1].position != one.objects[1].position

    def test_soft_requirements_are_on_as_often_as_in_scenic(self):
        program = vj.scenic(
            "ego = new Object at Range(-1, 1) @ 0\nrequire[0.5] ego.position.x > 0\n"
        )
        u = np.random.default_rng(0).random((20_000, 2), np.float32)
        u = u[np.asarray(program.space.accepts_points(u))]
        features = program.space.features_at(u)
        assert np.mean(features["require.line2"]) == pytest.approx(0.5, abs=0.02)
        # Scenic: on in half of the scenes, of which the others are positive by half.
        assert np.mean(features["ego.position.x"] < 0) == pytest.approx(0.25, abs=0.02)

    def test_verifai_leaves_nothing_behind(self):
        vj.scenic(GALLERY / "verifai.scenic")
        assert "verifai" not in sys.modules

    def test_scenic_says_where_a_program_is_wrong(self, tmp_path):
        file = tmp_path / "bad.scenic"
        file.write_text("ego = new Object at Range(0, 1) @ 0\nego = new Objekt at 1 @ 2\n")
        with pytest.raises(ProgramError, match=r"bad.scenic, line 2: NameError: .*Objekt"):
            vj.scenic(file)
        file.write_text("ego = new Object at at 0\n")
        with pytest.raises(ProgramError, match=r"bad.scenic, line 1: ScenicParseError"):
            vj.scenic(file)
        with pytest.raises(ProgramError, match=r"no file .*; .* has bad.scenic"):
            vj.scenic(tmp_path / "good.scenic")
        with pytest.raises(ProgramError, match="draws nothing at random"):
            vj.scenic("ego = new Object at 0 @ 0")

    def test_three_dimensions_are_computed_by_scenic(self):
        program = vj.scenic(
            "ego = new Object at (Range(0, 1), 0, Range(2, 3)), facing (Range(0, 1), 0.2, 0)\n",
            mode2D=False,
        )
        assert not program.compiled
        assert program.in_python["ego.x"] == "a program that is not planar"
        u = jnp.full(program.space.dim, 0.25)
        scene = jax.jit(lambda u: program.scenes(program.space.unflatten(u)))(u)
        assert float(scene["ego"]["x"]) == pytest.approx(0.25)
        assert float(scene["ego"]["z"]) == pytest.approx(2.25)
        assert float(scene["ego"]["pitch"]) == pytest.approx(0.2)

    @pytest.mark.slow
    def test_a_run_over_compiled_scenes(self, tmp_path):
        program = vj.scenic(GALLERY / "cones.scenic")

        def brake(scene, key):
            """Brake for the broken car, and stop before it or not."""
            ego, broken = scene["ego"], scene["broken"]
            time = jnp.arange(40) * 0.2
            speed = jnp.maximum(ego["speed"] - 4.0 * time, 0.0)
            ahead = jnp.hypot(broken["x"] - ego["x"], broken["y"] - ego["y"]) - 4.5
            return vj.Trace({"gap": ahead - jnp.cumsum(speed) * 0.2}, dt=0.2)

        problem = vj.Problem("cones", program.space, program.system(brake), "always gap > 0")
        run = vj.falsify(problem, "uniform", budget=256, batch=256, seed=1, confirm=False)
        assert len(run.table.counterexamples)
        row = int(run.table.counterexamples.index[0])
        scene = program.of(run, row)
        ego = scene.egoObject
        assert ego.speed == pytest.approx(run.table.row(row)["ego.speed"], rel=1e-6)
        assert "new Cone" in program.code(scene)
        again = program.from_bytes(program.to_bytes(scene))
        assert again.egoObject.position.x == pytest.approx(ego.position.x)
        program.draw(scene, tmp_path / "scene.png")
        assert (tmp_path / "scene.png").stat().st_size > 5000
        # No row of the table is a scene that Scenic refuses.
        rows = run.table.all
        for i in range(0, len(rows), 64):
            assert program.refusal(program.space.from_row(rows.iloc[i])) is None

    def test_a_black_box_gets_the_scene(self):
        program = vj.scenic(GALLERY / "near.scenic")

        def distance(scene):
            ego, other = scene.objects
            return vj.Trace({"distance": np.full(3, ego.position.distanceTo(other.position))}, 1.0)

        problem = vj.Problem(
            "near", program.space, program.blackbox(distance), "always distance < 8"
        )
        run = vj.falsify(problem, "uniform", budget=32, batch=32, seed=0, confirm=False)
        row = run.table.row(3)
        there = math.hypot(
            *(row[f"other.position.{c}"] - row[f"ego.position.{c}"] for c in ("x", "y"))
        )
        assert row["rho"] == pytest.approx(8 - there, abs=1e-3)

    def test_a_scene_that_scenic_refuses_is_an_error(self):
        program = vj.scenic(GALLERY / "near.scenic")
        together = {f"{o}.position.{c}": 1.0 for o in ("ego", "other") for c in "xy"}
        features = {**together, "ego.heading": 0.0, "other.heading": 10.0}
        assert "ntersect" in str(program.refusal(features))
        with pytest.raises(ValueError, match="Scenic refuses this scene"):
            program.scene(features)

    def test_scenic_decides_of_a_single_scene_as_of_many(self):
        program = vj.scenic(GALLERY / "chase.scenic")
        features = {"lead.position.y": 20.0, "lead.behavior": 1.0, "ego.behavior": 4.0}
        assert program.space.coerce(features)["lead.position.y"] == 20.0

    @pytest.mark.slow
    def test_dynamic_scenarios_run_in_workers(self):
        program = vj.scenic(GALLERY / "chase.scenic")
        here = program.simulator(steps=30, records=("gap", "place"))
        features = {"lead.position.y": 20.0, "lead.behavior": 1.0, "ego.behavior": 4.0}
        features = program.space.coerce(features)
        one, other = here(features, 7), here(features, 7)
        assert one.dt == pytest.approx(0.1)
        assert one.signals["place"].shape == (one.length, 3)
        np.testing.assert_array_equal(one.signals["gap"], other.signals["gap"])
        assert float(one.signals["gap"][0]) == pytest.approx(15.5)
        assert not np.array_equal(one.signals["gap"], here(features, 8).signals["gap"])
        pooled = program.simulator(steps=30, records=("gap", "place"), workers=1)
        np.testing.assert_array_equal(pooled(features, 7).signals["gap"], one.signals["gap"])
        pooled.close()
        with pytest.raises(ValueError, match="unknown record 'gapp'; did you mean 'gap'"):
            program.simulator(steps=2, records=("gapp",))
        with pytest.raises(ValueError, match="steps must be"):
            program.simulator(steps=0)

    @pytest.mark.slow
    def test_the_code_of_the_page_runs(self, monkeypatch, capsys):
        root = GALLERY.parents[3]
        monkeypatch.chdir(root)
        # What follows is for those who run Scenic with their own simulator.
        page = (root / "docs" / "scenic.md").read_text().split("## Your runner")[0]
        blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
        names: dict = {"__name__": "page"}
        for block in blocks:
            exec(compile(block, "scenic.md", "exec"), names)
        assert "simulations violate the property" in capsys.readouterr().out
        assert names["chased"].table.all["status"].eq("ok").any()
