"""A run cut into the jobs of an array, and merged: the table is the one of one machine."""

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import verifai_jax as vj
from verifai_jax.core.store.log import MARK, Log
from verifai_jax.falsification.shards import SHARD, Shard, merge, simulate_shard


def line(features, key):
    return vj.Trace({"x": features["a"] * jnp.ones(3) + features["b"]}, dt=0.1)


SPACE = {"a": vj.Box(0, 3), "b": vj.Box(-1, 1)}
LINE = vj.Problem("line", SPACE, line, "always x < 3.5", nominal={"a": 1.0, "b": 0.0})


def decay(features):
    if features["a"] > 0.9:
        raise ValueError("too large")
    return vj.Trace({"x": features["a"] * np.exp(-np.arange(5) * 0.1)}, dt=0.1)


DECAY = vj.Problem("decay", {"a": vj.Box(-1, 1)}, vj.blackbox(decay), "always x < 0.5")


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    root = tmp_path_factory.mktemp("parts")
    for number in (3, 1, 2):
        simulate_shard(LINE, Shard(number, 3), budget=5000, batch=1024, folder=root / str(number))
    return root


def test_merged_parts_are_the_run_of_one_machine(parts, tmp_path):
    merged = merge(sorted(parts.iterdir()), LINE, folder=tmp_path / "merged")
    whole = vj.falsify(LINE, "uniform", 5000, batch=1024)
    pd.testing.assert_frame_equal(merged.table.all, whole.table.all, check_exact=True)
    assert merged.failure_rate == whole.failure_rate
    assert merged.notes == whole.notes
    assert vj.load(tmp_path / "merged", LINE).simulations == 5000
    longer = vj.resume(tmp_path / "merged", LINE, budget=6000)
    assert longer.simulations == 6000


@pytest.mark.thorough
def test_black_boxes_keep_their_messages(tmp_path):
    for number in (1, 2):
        simulate_shard(DECAY, Shard(number, 2), budget=60, folder=tmp_path / str(number))
    merged = merge([tmp_path / "1", tmp_path / "2"], DECAY)
    whole = vj.falsify(DECAY, "uniform", 60)
    pd.testing.assert_frame_equal(merged.table.all, whole.table.all, check_exact=True)
    assert "too large" in merged.table.failed["message"].iloc[0]


def test_a_part_that_was_killed_goes_on_where_it_was(parts, tmp_path):
    folder = tmp_path / "2"
    options = {"budget": 5000, "batch": 1024, "folder": folder}
    simulate_shard(LINE, Shard(2, 3), **options)
    whole, last = (folder / SHARD).read_bytes(), Log(folder / SHARD).names()[-1]
    # Killed in the middle of its last block.
    (folder / SHARD).write_bytes(whole[:-100])
    simulated = []
    with pytest.MonkeyPatch.context() as patch:
        put = Log.put
        patch.setattr(Log, "put", lambda log, block: [simulated.append(*block), put(log, block)])
        simulate_shard(LINE, Shard(2, 3), **options)
        assert simulated == [last]
        simulate_shard(LINE, Shard(2, 3), **options)
        assert simulated == [last]
    for name in (name for name in Log(folder / SHARD).names() if name != "about"):
        block = Log(parts / "2" / SHARD).get(name)
        again = Log(folder / SHARD).get(name)
        assert all(block[n].tobytes() == v.tobytes() for n, v in again.items())
    with pytest.raises(ValueError, match=r"holds another part: its seed is 0, here 1"):
        simulate_shard(LINE, Shard(2, 3), **options, seed=1)


def test_parts_that_do_not_fit_are_named(parts, tmp_path):
    one, two, three = sorted(parts.iterdir())
    with pytest.raises(ValueError, match=r"2/3 missing"):
        merge([one, three], LINE)
    with pytest.raises(ValueError, match=r"part 1 is there twice"):
        merge([one, one, two, three], LINE)
    simulate_shard(LINE, Shard(3, 3), budget=4000, batch=1024, folder=tmp_path / "other")
    with pytest.raises(ValueError, match=r"its budget is 4000, there 5000"):
        merge([one, two, tmp_path / "other"], LINE)
    with pytest.raises(FileNotFoundError, match=r"it has no shard.rows"):
        merge([tmp_path], LINE)
    with pytest.raises(ValueError, match="with other formulas or features"):
        merge([one, two, three], vj.Problem("line", SPACE, line, "always x < 3.4"))


def test_damaged_and_unfinished_parts_are_named(parts, tmp_path):
    copies = []
    for place in sorted(parts.iterdir()):
        copies.append(tmp_path / place.name)
        copies[-1].mkdir()
        for file in place.iterdir():
            if file.is_file():
                (copies[-1] / file.name).write_bytes(file.read_bytes())
    file = copies[1] / SHARD
    content = file.read_bytes()
    for damaged in (content[:-1] + b"!", content[: content.rindex(MARK)]):
        file.write_bytes(damaged)
        told = r"row 2048 is in none of the parts: one is not finished, or damaged; run it again"
        with pytest.raises(vj.RunError, match=told):
            merge(copies, LINE)
    file.write_bytes(content[content.index(MARK, 1) :])
    with pytest.raises(ValueError, match=r"shard.rows is damaged: it does not say which part"):
        merge(copies, LINE)


def test_what_cannot_be_cut_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"learns from all rows.*uniform"):
        simulate_shard(LINE, Shard(1, 2), "cross_entropy", folder=tmp_path)
    for text in ("3", "0/4", "5/4", "a/b", "1/0"):
        with pytest.raises(ValueError, match="shard"):
            Shard.parse(text)
    assert Shard.parse("3/16") == Shard(3, 16)
    assert str(Shard(3, 16)) == "3/16"


def test_every_row_is_in_one_part():
    for budget, of, unit in ((5000, 3, 512), (10, 16, 1), (100, 7, 64), (1, 1, 512)):
        rows = [i for number in range(1, of + 1) for i in Shard(number, of).rows(budget, unit)]
        assert rows == list(range(budget))
