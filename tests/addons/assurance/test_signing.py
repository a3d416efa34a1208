"""Signed manifests, and the verifier that needs Python alone: tampering of every kind is found."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import verifai_jax as vj
from verifai_jax.addons.assurance import verify_report
from verifai_jax.addons.assurance.commands.sign import sign
from verifai_jax.addons.assurance.verify_report import findings, is_signed, read_key
from verifai_jax.core.messages.errors import MissingExtra

ed25519 = pytest.importorskip("cryptography.hazmat.primitives.asymmetric.ed25519")
from cryptography.hazmat.primitives import serialization  # noqa: E402
from cryptography.hazmat.primitives.asymmetric import rsa  # noqa: E402

RFC_8032 = [
    # Secret key is not needed: public key, message, signature of tests 1 to 3 of section 7.1.
    ("d75a980182b10ab7d54bfed3c964073a0ee172f3daa62325af021a68f707511a", "",
     "e5564300c360ac729086e2cc806e828a84877f1eb8e5d974d873e065224901555fb8821590a33bacc61e39701cf9b4"
     "6bd25bf5f0595bbe24655141438e7a100b"),
    ("3d4017c3e843895a92b70aa74d1b7ebc9c982ccf2ec4968cc0cd55f12af4660c", "72",
     "92a009a9f0d4cab8720e820b5f642540a2b27b5416503f8fb3762223ebdb69da085ac1e43e15996e458f3613d0f11d"
     "8c387b2eaeb4302aeeb00d291612bb0c00"),
    ("fc51cd8e6218a1a38da47ed00230f0580816ed13ba3303ac5deb911548908025", "af82",
     "6291d657deec24024827e69c3abe01a30ce548a284743a445e3680d7db5ac3ac18ff9b538d16f290ae67f760984dc6"
     "594a7c15e9716ed28dc027beceea1ec40a"),
]  # fmt: skip


@pytest.mark.parametrize(("key", "message", "signature"), RFC_8032)
def test_signatures_of_the_standard(key, message, signature):
    key, message, signature = map(bytes.fromhex, (key, message, signature))
    assert is_signed(key, message, signature)
    assert not is_signed(key, message + b"x", signature)


def test_signatures_against_cryptography():
    rng = np.random.default_rng(0)
    for _ in range(8):
        private = ed25519.Ed25519PrivateKey.from_private_bytes(rng.bytes(32))
        key, message = private.public_key().public_bytes_raw(), rng.bytes(int(rng.integers(200)))
        signature = private.sign(message)
        assert is_signed(key, message, signature)
        for place in rng.integers(64, size=3):
            wrong = bytearray(signature)
            wrong[place] ^= 1 << int(rng.integers(8))
            assert not is_signed(key, message, bytes(wrong))
        # The same signature with its number greater by the order of the group.
        s = int.from_bytes(signature[32:], "little") + verify_report.ORDER
        assert not is_signed(key, message, signature[:32] + s.to_bytes(32, "little"))
    assert not is_signed(b"\xff" * 32, b"", b"\x00" * 64)
    assert not is_signed(b"", b"", b"")


@pytest.fixture
def signed(tmp_path):
    private = ed25519.Ed25519PrivateKey.generate()
    pem = serialization.Encoding.PEM
    (tmp_path / "key.pem").write_bytes(
        private.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    (tmp_path / "public.pem").write_bytes(
        private.public_key().public_bytes(pem, serialization.PublicFormat.SubjectPublicKeyInfo)
    )
    folder = tmp_path / "handed"
    (folder / "run" / "deep").mkdir(parents=True)
    for name in ("brake.html", "brake.claims.json", "run/table.parquet", "run/deep/run.json"):
        (folder / name).write_text(f"what {name} says")
    path = vj.sign_report(folder / "brake.html", tmp_path / "key.pem", [folder / "run"])
    assert path == folder / "brake.manifest.json"
    return path, read_key(str(tmp_path / "public.pem"))


def test_a_report_as_it_was_signed(signed):
    path, key = signed
    assert findings(path, key) == []
    manifest = json.loads(path.read_text())
    assert [entry["name"] for entry in manifest["files"]] == [
        "brake.claims.json", "brake.html", "run/deep/run.json", "run/table.parquet"
    ]  # fmt: skip
    assert read_key(manifest["public_key"]) == key
    assert findings(path, bytes(31) + b"\x01") != []


def edited(path, change):
    manifest = json.loads(path.read_text())
    change(manifest)
    path.write_text(json.dumps(manifest))


TAMPERING = {
    "a byte of the report": (
        lambda p: (p.parent / "brake.html").write_text("What brake.html says"),
        "brake.html was changed",
    ),
    "claims": (
        lambda p: (p.parent / "brake.claims.json").write_text("{}"),
        "brake.claims.json was changed",
    ),
    "a file is gone": (
        lambda p: (p.parent / "run/table.parquet").unlink(),
        "run/table.parquet is missing",
    ),
    "a file is added": (
        lambda p: (p.parent / "run/deep/more.json").write_text(""),
        "run/deep/more.json was added",
    ),
    "a file is a folder": (
        lambda p: ((p.parent / "brake.html").unlink(), (p.parent / "brake.html").mkdir()),
        "brake.html is missing",
    ),
    "a link out of the folder": (
        lambda p: (
            (p.parent / "brake.html").rename(p.parent.parent / "else.html"),
            (p.parent / "brake.html").symlink_to(p.parent.parent / "else.html"),
        ),
        "brake.html is outside of the folder of the manifest",
    ),
    "a hash": (
        lambda p: edited(p, lambda m: m["files"][0].update(sha256="0" * 64)),
        "is not signed by the owner of this key, or was changed",
    ),
    "an entry less": (lambda p: edited(p, lambda m: m["files"].pop()), "is not signed"),
    "a folder less": (lambda p: edited(p, lambda m: m["folders"].clear()), "is not signed"),
    "an entry more": (lambda p: edited(p, lambda m: m.update(note="")), "is not signed"),
    "another signature": (
        lambda p: edited(p, lambda m: m.update(signature="00" * 64)), "is not signed"
    ),
    "no signature": (lambda p: edited(p, lambda m: m.pop("signature")), "is no signed manifest"),
    "a signature that is no text": (
        lambda p: edited(p, lambda m: m.update(signature=3)), "is no signed manifest"
    ),
    "no object": (lambda p: p.write_text("[1]"), "is no signed manifest"),
    "no JSON": (lambda p: p.write_text("{"), "is no signed manifest"),
    "depth": (lambda p: p.write_text("[" * 100_000), "is no signed manifest"),
}  # fmt: skip


@pytest.mark.parametrize("kind", TAMPERING)
def test_tampering_is_found(signed, kind):
    path, key = signed
    change, words = TAMPERING[kind]
    change(path)
    assert [words in each for each in findings(path, key)] == [True]


def test_another_signer_is_found(signed, tmp_path):
    path, key = signed
    other = ed25519.Ed25519PrivateKey.generate()

    def sign_again(manifest):
        manifest["public_key"] = other.public_key().public_bytes_raw().hex()
        manifest["signature"] = other.sign(verify_report.message_of(manifest)).hex()

    edited(path, sign_again)
    assert "is not signed by the owner of this key" in findings(path, key)[0]


def test_a_signed_name_never_leads_out_of_the_folder(signed, tmp_path):
    """Not even one that was signed."""
    path, _ = signed
    private = serialization.load_pem_private_key((tmp_path / "key.pem").read_bytes(), None)
    (tmp_path / "secret").write_text("")

    def point_out(manifest):
        manifest["files"].append({"name": "../secret", "sha256": "0" * 64})
        manifest["signature"] = private.sign(verify_report.message_of(manifest)).hex()

    edited(path, point_out)
    key = private.public_key().public_bytes_raw()
    assert findings(path, key) == ["../secret is outside of the folder of the manifest"]


def test_the_verifier_needs_python_alone(signed, tmp_path):
    """Another interpreter without packages, and without this one's path."""
    path, _ = signed
    script = tmp_path / "verify_report.py"
    script.write_text(Path(verify_report.__file__).read_text())
    clean = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}

    def run(*key):
        command = [sys.executable, "-S", "-I", str(script), str(path), *key]
        return subprocess.run(command, env=clean, text=True, capture_output=True, cwd="/")

    good = run("--key", str(tmp_path / "public.pem"))
    assert (good.returncode, good.stdout) == (
        0, "The signature is of this key, and all files are as signed.\n"
    )  # fmt: skip
    (path.parent / "brake.html").write_text("")
    bad = run("--key", json.loads(path.read_text())["public_key"])
    assert (bad.returncode, bad.stdout) == (1, "brake.html was changed\n")
    assert run().returncode == 2


def test_what_cannot_be_signed(signed, tmp_path, monkeypatch):
    report = signed[0].parent / "brake.html"
    with pytest.raises(FileNotFoundError, match=r"there is no key .*; make one with: openssl"):
        vj.sign_report(report, tmp_path / "none.pem")
    with pytest.raises(ValueError, match=r"public.pem cannot be read as a private key"):
        vj.sign_report(report, tmp_path / "public.pem")
    with pytest.raises(FileNotFoundError, match=r"there is no file .*gone.html to sign"):
        vj.sign_report(tmp_path / "gone.html", tmp_path / "key.pem")
    with pytest.raises(ValueError, match=r"is outside of .*handed, the folder of the report"):
        vj.sign_report(report, tmp_path / "key.pem", [tmp_path / "key.pem"])
    key = rsa.generate_private_key(65537, 1024).private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )  # fmt: skip
    (tmp_path / "rsa.pem").write_bytes(key)
    with pytest.raises(ValueError, match=r"rsa.pem is no key of Ed25519"):
        vj.sign_report(report, tmp_path / "rsa.pem")
    monkeypatch.setitem(sys.modules, "cryptography", None)
    with pytest.raises(MissingExtra, match=r"pip install 'verifai_jax\[signing\]'"):
        vj.sign_report(report, tmp_path / "key.pem")


def test_the_command_signs_the_folder_that_it_is_in(signed, tmp_path):
    path, key = signed
    path.unlink()
    result = CliRunner().invoke(
        sign,
        [str(path.parent / "brake.html"), str(path.parent), "--key", str(tmp_path / "key.pem")],
    )
    assert result.exit_code == 0, result.output
    assert findings(path, key) == []
    (path.parent / "new.txt").write_text("")
    assert findings(path, key) == ["new.txt was added"]
