"""Only regular files are opened, and what they declare is checked before it is made."""

import os
import socket
import zipfile

import numpy as np
import pandas as pd
import pytest
from mutated import limited

from verifai_jax.core.store import foreign_archives
from verifai_jax.core.store.files import is_of
from verifai_jax.core.store.foreign_archives import open_archive, read_arrays, read_parquet
from verifai_jax.core.store.foreign_files import (
    ForeignFileError,
    open_file,
    parse_toml,
    read_bytes,
    read_json,
    read_text,
    read_xml,
    read_yaml,
)


def test_what_is_no_regular_file_is_named(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(os.fspath(tmp_path / "socket"))
        told = {"pipe": "a named pipe", "socket": "a socket", "": "a folder"}
        for name, kind in told.items():
            for read in (open_file, read_bytes, read_text, read_json):
                with pytest.raises(ForeignFileError, match=rf"is {kind}; give a regular file$"):
                    read(tmp_path / name)
    with pytest.raises(ForeignFileError, match=r"^/dev/zero is a device; give a regular file$"):
        read_bytes("/dev/zero")
    with pytest.raises(FileNotFoundError):
        read_bytes(tmp_path / "none")


def test_links_and_sizes(tmp_path):
    folder = tmp_path / "it"
    (folder / "deep").mkdir(parents=True)
    (tmp_path / "secret").write_text("secret")
    (folder / "deep" / "own").write_text("own")
    (folder / "out").symlink_to(tmp_path / "secret")
    (folder / "in").symlink_to(folder / "deep" / "own")
    (folder / "circle").symlink_to(folder / "circle")
    (tmp_path / "link").symlink_to(folder)
    assert read_bytes(tmp_path / "link" / "in", within=tmp_path / "link") == b"own"
    assert read_bytes(folder / "out") == b"secret"
    with pytest.raises(ForeignFileError, match=r"out is a link out of .*it; give a regular file"):
        read_bytes(folder / "out", within=folder)
    with pytest.raises(OSError, match="levels of symbolic links"):
        read_bytes(folder / "circle", within=folder)
    with open(tmp_path / "sparse", "wb") as file:
        file.truncate(1 << 40)
    with (
        limited(),
        pytest.raises(ForeignFileError, match=r"has 1,099,511,627,776 bytes; at most 4"),
    ):
        read_bytes(tmp_path / "sparse")


@pytest.mark.thorough
def test_nested_and_shared_texts(tmp_path):
    deep = 100_000
    aliases = "\n".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 11))
    with limited():
        for text in (f"a0: &a0 [x]\n{aliases}", "a: &a [*a]"):
            with pytest.raises(
                ValueError, match="its aliases stand for more than 1,000,000 values"
            ):
                read_yaml(text)
        assert read_yaml("a: &a [1]\nb: *a") == {"a": [1], "b": [1]}
        assert read_yaml("") is None
        for read, text in ((read_yaml, "[" * deep), (parse_toml, "a=" + "[" * deep)):
            with pytest.raises(ValueError, match="nested too deeply"):
                read(text)
        (tmp_path / "deep.json").write_text("[" * deep)
        with pytest.raises(ValueError, match=r"deep.json cannot be read as JSON \("):
            read_json(tmp_path / "deep.json")
        with pytest.raises(
            ValueError, match=r"deep.xml is not XML: its elements .* deeper than 200"
        ):
            read_xml(b"<a>" * deep + b"</a>" * deep, "deep.xml")
        entity = b'<!DOCTYPE a [<!ENTITY b "&c;">]><a>&b;</a>'
        with pytest.raises(ValueError, match="declares a document type, <!DOCTYPE a>"):
            read_xml(entity, "it.xml")


def test_declared_sizes(tmp_path, monkeypatch):
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("zeros", bytes(10_000_000))
    with pytest.raises(ForeignFileError, match="it unpacks to 10 MB; at most 1 MB are read"):
        open_archive(tmp_path / "bomb.zip", "it", 10**6)
    header = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }".ljust(117)
    member = b"\x93NUMPY\x01\x00v\x00" + f"{header}\n".encode()
    with zipfile.ZipFile(tmp_path / "huge.npz", "w") as archive:
        archive.writestr("a.npy", member)
    with (
        limited(),
        pytest.raises(ForeignFileError, match=r"'a' of it is not an array: .* bytes of"),
    ):
        read_arrays(tmp_path / "huge.npz", "it")
    pd.DataFrame({"x": np.zeros(2000)}).to_parquet(tmp_path / "long.parquet", index=False)
    assert len(read_parquet(tmp_path / "long.parquet")) == 2000
    monkeypatch.setattr(foreign_archives, "MAX_VALUES", 1000)
    with pytest.raises(
        ForeignFileError, match=r"long.parquet declares 2,000 values; at most 1,000"
    ):
        read_parquet(tmp_path / "long.parquet")


def test_pickled_arrays_are_refused(tmp_path):
    np.savez(tmp_path / "o.npz", a=np.array([{}], object))
    with pytest.raises(ForeignFileError, match="'a' of it is not an array"):
        read_arrays(tmp_path / "o.npz", "it")
    np.savez(tmp_path / "some.npz", none=np.zeros((0, 3)), text=np.array("a"), whole=np.arange(3))
    read = read_arrays(tmp_path / "some.npz", "it")
    assert {name: array.shape for name, array in read.items()} == {
        "none": (0, 3),
        "text": (),
        "whole": (3,),
    }


def test_plain_data_fits_its_annotation():
    texts = dict[str, str]
    for value, kind in (
        (1, int),
        (1, float),
        (1.5, float),
        (None, str | None),
        ({"a": "b"}, texts),
    ):
        assert is_of(value, kind)
    for value, kind in (
        (True, int), (10**400, float), (2**63, int), ("1", int), (None, str), ({"a": 1}, texts),
        ([1], list[str]), ("ab", list[str]), (1.5, int),
    ):  # fmt: skip
        assert not is_of(value, kind)
