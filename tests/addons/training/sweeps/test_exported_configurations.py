"""Configurations that leave a sweep: exported, loaded, trained again, and as Optuna's trials."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drifting import drifting, quick_certificates

import verifai_jax as vj
from verifai_jax.addons.training.sweeps import load_configuration
from verifai_jax.addons.training.sweeps import running as driver
from verifai_jax.addons.training.sweeps._sweep import sweep
from verifai_jax.addons.training.sweeps.trainer import StudyError
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.core.store.files import DamagedError, read_record, write_record

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def swept():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driver, "certify", quick_certificates)
        space = {"rate": vj.LogUniform(0.01, 1.0), "steps": vj.Categorical(96, 128)}
        return sweep(
            drifting(space, seeds=(3,)), configurations=3,
            certification=vj.Certification(samples=64),
        )  # fmt: skip


def partly_certified(swept):
    """Return a sweep of whose three configurations one raised, and one was stopped."""
    columns = {name: np.copy(column) for name, column in swept.record.columns.items()}
    columns["kind"] = np.array(["relu", "tanh", "tanh"], object)[columns["configuration"]]
    for name in ("failure_rate", "failure_high", "nominal_return"):
        columns[name] = np.where(columns["configuration"] == 0, np.nan, columns[name])
    columns["status"] = np.array(["error: odd", "trained", "stopped"], object)[
        columns["configuration"]
    ]
    columns["verdict"] = np.where(columns["configuration"] == 0, "", columns["verdict"])
    names = (*swept.hyperparameters, "kind")
    return replace(swept, record=replace(swept.record, columns=columns, hyperparameters=names))


def bits(policy):
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(policy)]


@pytest.mark.slow
def test_trained_again_to_the_same_bits(swept, tmp_path, caplog):
    pytest.importorskip("onnx")
    for row in swept.table.index:
        loaded = load_configuration(swept.export(tmp_path / str(row), row))
        assert loaded.steps == swept.table.loc[row, "steps"]
        assert loaded.seed == 3
        assert bits(loaded.train(swept.study)) == bits(swept.policy(row))
        seen = jnp.array([0.3, 1.0])
        np.testing.assert_allclose(
            loaded.policy.act(seen), swept.policy(row).act(seen), rtol=1e-5, atol=1e-6
        )
    assert not caplog.records
    best = load_configuration(swept.export(tmp_path / "best"))
    assert best.certificate["verdict"] == swept.best["verdict"]
    assert best.hyperparameters["rate"] == swept.best["rate"]
    best.hyperparameters["rate"] *= 1.01
    best.train(swept.study)
    assert "other numbers here" in caplog.text


def test_what_cannot_be_loaded_or_trained_again(swept, tmp_path):
    pytest.importorskip("onnx")
    with pytest.raises(FileNotFoundError):
        load_configuration(tmp_path)
    best = load_configuration(swept.export(tmp_path))
    other = vj.Study("other", swept.study.space, swept.study.trainer, swept.study.problem)
    with pytest.raises(StudyError, match="of 'drifting'; got study 'other'"):
        best.train(other)
    best.hyperparameters["steps"] = 64
    object.__setattr__(best, "steps", 96)
    with pytest.raises(StudyError, match="that of 96 steps"):
        best.train(swept.study)
    policy = tmp_path / "policy.onnx"
    whole = policy.read_bytes()
    policy.write_bytes(whole[:-9] + bytes([whole[-9] ^ 1]) + whole[-8:])
    with pytest.raises(DamagedError, match=r"policy\.onnx is not the policy of configuration"):
        load_configuration(tmp_path)
    policy.write_bytes(whole)
    file = tmp_path / "configuration.json"
    record = read_record(file)
    earlier = {name: record[name] for name in record if name not in ("called", "onnx")}
    write_record(file, earlier)
    assert load_configuration(tmp_path).called == record["steps"]
    file.write_text(file.read_text().replace('"seed": 3', '"seed": 4'))
    with pytest.raises(DamagedError, match="has changed"):
        load_configuration(tmp_path)


def test_the_trials_are_those_of_optuna(swept):
    pytest.importorskip("optuna")
    ours, theirs = swept.trials_dataframe(), swept.to_optuna().trials_dataframe()
    for name in ("number", "values_0", "values_1", "params_rate", "params_steps"):
        np.testing.assert_allclose(ours[name], theirs[name].astype(float), rtol=1e-6)
    for name in ("user_attrs_verdict", "user_attrs_status", "state"):
        assert list(ours[name]) == list(theirs[name])
    assert {*ours["state"]} == {"COMPLETE"}
    halved = partly_certified(swept)
    assert list(halved.trials_dataframe()["state"]) == ["FAIL", "COMPLETE", "PRUNED"]
    assert list(halved.to_optuna().trials_dataframe()["state"]) == ["FAIL", "COMPLETE", "PRUNED"]


@pytest.mark.parametrize("kind", ["parallel", "slices"])
def test_pictures_that_people_know(swept, tmp_path, kind):
    figure = swept.plot(tmp_path / "a.png", kind=kind)
    assert (tmp_path / "a.png").stat().st_size > 1000
    axes = figure.axes
    if kind == "slices":
        assert [each.get_xlabel() for each in axes] == ["rate", "steps"]
        assert axes[0].get_xscale() == "log"
        shown = np.concatenate([each.get_offsets()[:, 0] for each in axes[0].collections])
        np.testing.assert_allclose(sorted(shown), sorted(swept.configurations["rate"]))
        halved = partly_certified(swept).plot(tmp_path / "b.png", kind=kind).axes[-1]
        assert [each.get_text() for each in halved.get_xticklabels()] == ["tanh"]
    else:
        assert {each.get_text() for each in axes[0].get_legend().texts} == {
            *swept.configurations["verdict"]
        }
        assert len(axes[0].lines) == len(swept.configurations)
        for line, (_, row) in zip(axes[0].lines, swept.configurations.iterrows(), strict=True):
            np.testing.assert_allclose(line.get_ydata()[-1], row["failure_rate"])
    with pytest.raises(UnknownNameError, match="did you mean 'slices'"):
        swept.plot(kind="slice")
