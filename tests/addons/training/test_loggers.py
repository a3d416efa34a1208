"""Ready loggers, read back by other programs, and the rules of callbacks."""

import struct

import pandas as pd
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.addons.training.loggers import crc32c
from verifai_jax.core.user_code.callbacks import check_callbacks, notify


def test_a_csv_file_gets_columns_as_they_come_and_is_continued(tmp_path):
    path = tmp_path / "logs" / "run.csv"
    log = vj.CSVLogger(path)
    log(16, {"found": 0, "best": 0.25})
    log(32, {"found": 2, "best": -1.5, "rate": 0.1})
    vj.CSVLogger(path)(48, {"best": -2.0, "found": 3})
    table = pd.read_csv(path)
    assert list(table.columns) == ["step", "found", "best", "rate"]
    assert table["step"].tolist() == [16, 32, 48]
    assert table["best"].tolist() == [0.25, -1.5, -2.0]
    assert table["rate"].isna().tolist() == [True, False, True]
    other = tmp_path / "table.csv"
    other.write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="its first column is 'a', not 'step'"):
        vj.CSVLogger(other)
    assert other.read_text() == "a,b\n1,2\n"


def test_checksum_is_that_of_the_standard():
    # RFC 3720, B.4, and the usual check value.
    assert crc32c(b"123456789") == 0xE3069283
    assert crc32c(bytes(32)) == 0x8A9136AA
    assert crc32c(bytes(range(32))) == 0x46DD794E


def records(path):
    """Split a file into its records and check the checksums."""
    content = path.read_bytes()
    while content:
        (length,) = struct.unpack("<Q", content[:8])
        for part, mask in ((content[:8], content[8:12]), (content[12 : 12 + length], None)):
            mask = content[12 + length : 16 + length] if mask is None else mask
            crc = crc32c(part)
            rotated = ((crc >> 15) | (crc << 17)) + 0xA282EAD8
            assert struct.unpack("<I", mask)[0] == rotated & 0xFFFFFFFF
        yield content[12 : 12 + length]
        content = content[16 + length :]


def test_an_event_file_is_read_by_the_definition_of_events(tmp_path):
    event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2")
    log = vj.TensorBoardLogger(tmp_path / "logs", prefix="falsify/")
    log(1, {"best": -0.5})
    log(70_000, {"best": 1e-3, "found": 300})
    (path,) = (tmp_path / "logs").iterdir()
    assert path.name.startswith("events.out.tfevents.")
    events = [event_pb2.Event.FromString(record) for record in records(path)]
    assert events[0].file_version == "brain.Event:2"
    assert [event.step for event in events[1:]] == [1, 70_000]
    values = {value.tag: value.simple_value for value in events[2].summary.value}
    assert values == {"falsify/best": pytest.approx(1e-3), "falsify/found": 300.0}
    assert events[2].wall_time >= events[1].wall_time > 1.7e9


def test_callbacks_get_numbers_that_are_there_and_a_copy_each():
    seen = []

    def spoil(step, values):
        seen.append((step, dict(values)))
        values.clear()

    notify(check_callbacks([spoil, spoil]), 3, {"a": 1, "b": float("nan")})
    assert seen == [(3, {"a": 1})] * 2
    with unchecked(), pytest.raises(TypeError, match="callbacks must be a list of functions; got"):
        check_callbacks(print)
    with unchecked(), pytest.raises(TypeError, match="a step and a dictionary of numbers; got 3"):
        check_callbacks([3])
