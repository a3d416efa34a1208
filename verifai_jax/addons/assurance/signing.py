"""The signed manifest of a report, which a third party checks without this package.

sign_report("brake.html", "key.pem", ["runs/brake-1"])    # writes brake.manifest.json
python verify_report.py brake.manifest.json --key public.pem
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from verifai_jax._version import __version__
from verifai_jax.addons.assurance.verify_report import message_of
from verifai_jax.addons.reports.document import claims_path
from verifai_jax.core.messages.errors import require
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.core.store.foreign_files import read_bytes
from verifai_jax.core.user_code.sources import file_hash

FORMAT = 1
"""Number of the format of manifests."""
MAX_KEY = 1 << 16
"""Maximum bytes of the file of a key."""
MAKE = "openssl genpkey -algorithm ed25519 -out key.pem"


def sign_report(
    report: str | Path, key: str | Path, files: Sequence[str | Path] = (),
    password: str | None = None,
) -> Path:  # fmt: skip
    """Write the manifest of a report: the hashes of its files, signed with Ed25519.

    It names the report, its claims, and further files, such as the run that it rests on. Of a
    folder it names all files, and the check refuses files that were added.

    **Arguments:**
    - `report`: the HTML file that `report` wrote.
    - `key`: the file of a private key (PEM, Ed25519).
    - `files`: further files and folders, within the folder of the report.
    - `password`: the password of the key, if it has one.
    **Returns:** the path of the manifest, beside the report.
    **Raises:** `MissingExtra` without cryptography; `FileNotFoundError`; `ValueError` for another
    kind of key, and for files outside of the folder of the report.
    """
    report = Path(report)
    private, public = _keys(key, password)
    path = report.with_suffix(".manifest.json")
    top, entries = report.parent.resolve(), [report]
    entries += [claims] if (claims := claims_path(report)).is_file() else []
    folders = []
    for each in map(Path, files):
        if each.is_dir():
            folders.append(_name(each, top))
            entries += [file for file in sorted(each.rglob("*")) if file.is_file()]
        else:
            entries.append(each)
    hashes = {}
    for file in entries:
        if not file.is_file():
            raise FileNotFoundError(f"there is no file {file} to sign")
        if file.resolve() != path.resolve():
            hashes[_name(file, top)] = file_hash(file)
    manifest: dict[str, Any] = {
        "format": FORMAT, "signed_with": f"verifai_jax {__version__}", "public_key": public,
        "files": [{"name": name, "sha256": sha256} for name, sha256 in sorted(hashes.items())],
        "folders": sorted(folders),
    }  # fmt: skip
    manifest["signature"] = private.sign(message_of(manifest)).hex()
    with replacing(path) as partial:
        partial.write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")
    return path


def _name(file: Path, top: Path) -> str:
    """Return the name of a file relative to the folder of the manifest."""
    if not file.resolve().is_relative_to(top):
        raise ValueError(
            f"{file} is outside of {top}, the folder of the report, with which it is handed over: "
            "write the report into a folder above it, or copy it there"
        )
    return file.resolve().relative_to(top).as_posix()


def _keys(key: str | Path, password: str | None) -> tuple[Any, str]:
    """Return a private key, and its public key as hexadecimal digits."""
    require("cryptography", "signing")
    serialization = require("cryptography.hazmat.primitives.serialization", "signing")
    kinds = require("cryptography.hazmat.primitives.asymmetric.ed25519", "signing")
    if not Path(key).exists():
        raise FileNotFoundError(f"there is no key {key}; make one with: {MAKE}")
    secret = None if password is None else password.encode()
    try:
        private = serialization.load_pem_private_key(read_bytes(key, MAX_KEY), secret)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{key} cannot be read as a private key (PEM): {error}") from None
    if not isinstance(private, kinds.Ed25519PrivateKey):
        raise ValueError(f"{key} is no key of Ed25519; make one with: {MAKE}")
    return private, private.public_key().public_bytes_raw().hex()
