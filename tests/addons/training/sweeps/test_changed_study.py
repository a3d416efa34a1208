"""A sweep whose study has been edited between its parts."""

from dataclasses import replace

import pytest
from drifting import drifting, quick_certificates

import verifai_jax as vj
from verifai_jax.addons.rl import policy_sources
from verifai_jax.addons.training.sweeps import running as driver
from verifai_jax.addons.training.sweeps._sweep import sweep
from verifai_jax.addons.training.sweeps.result import load_sweep
from verifai_jax.addons.training.sweeps.study import Study
from verifai_jax.core.store.cache import CacheError
from verifai_jax.core.user_code.sources import Source


@pytest.mark.slow
def test_finished_work_of_another_study_is_not_gone_on_with(tmp_path, monkeypatch):
    monkeypatch.setattr(driver, "certify", quick_certificates)
    study, options = drifting(), {"configurations": 1, "folder": tmp_path / "work"}
    options["certification"] = vj.Certification(samples=8)
    whole = sweep(study, **options)
    (part,) = whole.record.sources
    assert any(name.endswith("drifting.py") for name, *_ in part["files"])
    assert sweep(study, **options).record.sources == whole.record.sources
    edited = replace(study.sources(), files=(Source("drift.py", "the problem", "0" * 64),))
    monkeypatch.setattr(Study, "sources", lambda self: edited)
    with pytest.raises(CacheError, match=r"same sweep with other files: drift\.py makes") as error:
        sweep(study, **options)
    assert "--even-if-changed" in str(error.value)
    again = sweep(study, **options, even_if_changed=True)
    assert len(again.record.sources) == 2
    assert "SEVERAL MODELS" in again.summary()
    again.save(tmp_path / "saved")
    assert load_sweep(tmp_path / "saved").record.sources == again.record.sources
    (policy, *_) = (tmp_path / "saved" / "policies").glob("*.npz")
    assert policy_sources(policy)["files"] == [["drift.py", "the problem", "0" * 64]]
