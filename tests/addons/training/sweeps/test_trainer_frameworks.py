"""PPO of Stable-Baselines3 and of Brax in a sweep, interrupted between two checkpoints."""

import numpy as np
import pytest
from framework_training import sweep

from verifai_jax.core.store.cache import Cache


@pytest.mark.slow
@pytest.mark.parametrize(("name", "package"), [("sb3", "stable_baselines3"), ("brax", "brax")])
def test_ppo_of_another_framework(name, package, tmp_path, monkeypatch):
    # Nine processes, in each of which the framework is imported and a training compiled.
    pytest.importorskip(package)
    whole = sweep(name, None)
    assert list(whole.table["status"]) == ["trained"] * 4, list(whole.table["status"])
    stored = []
    put = Cache.put

    def put_some(self, work):
        put(self, work)
        stored.extend(work)
        if len(stored) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(Cache, "put", put_some)
    assert not sweep(name, tmp_path).record.complete
    monkeypatch.undo()
    resumed = sweep(name, tmp_path)
    for column in ("steps", "failures", "worst_robustness", "verdict", "learning_rate"):
        one, other = whole.table[column].to_numpy(), resumed.table[column].to_numpy()
        np.testing.assert_array_equal(one, other, err_msg=column)
