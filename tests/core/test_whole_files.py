"""Files that replace others are whole, or those before them stay."""

import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.core.atomic_files import replacing
from verifai_jax.plotting.style import new_figure, show_or_save
from verifai_jax.rl import Continuous, Policy


def test_a_file_is_replaced_once_it_is_whole(tmp_path):
    path = tmp_path / "deep" / "report.html"
    with replacing(path) as partial:
        assert partial.suffix == ".html"
        partial.write_text("first")
        assert not path.exists()

    def interrupted():
        with replacing(path) as partial:
            partial.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "first"
    assert list(path.parent.iterdir()) == [path]


def test_what_cannot_be_written_is_named_and_keeps_what_was_there(tmp_path, monkeypatch):
    layers = ((np.zeros((1, 1), np.float32), np.zeros(1, np.float32)),)
    policy = Policy(layers, None, None, None, Continuous(-1.0, 1.0))
    path, picture = tmp_path / "p.npz", tmp_path / "nofile" / "x.png"
    vj.rl.save_policy(policy, path)
    before = path.read_bytes()

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OSError, match=r"p.npz cannot be written \(No space left on device\); give"):
        vj.rl.save_policy(policy, path)
    assert path.read_bytes() == before
    (tmp_path / "nofile").write_text("")
    with pytest.raises(OSError, match=r"x.png cannot be written \("):
        show_or_save(new_figure(), picture)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["nofile", "p.npz"]
