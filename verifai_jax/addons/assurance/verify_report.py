"""Check the signed manifest of a report. This file needs Python alone, and nothing beside it.

    python verify_report.py brake.manifest.json --key public.pem

The key is that of the signer, as a PEM file or 64 hexadecimal digits. It must come from the signer
by another way than the report. The exit code is 0 only if the signature is of this key and every
file is as it was signed. The signature is Ed25519 (RFC 8032).
"""

import argparse
import base64
import hashlib
import json
import os
import sys

P, ORDER = 2**255 - 19, 2**252 + 27742317777372353535851937790883648493
D, ROOT = -121665 * pow(121666, -1, P) % P, pow(2, (P - 1) // 4, P)


def add(p: tuple, q: tuple) -> tuple:
    """Add two points of the curve, in extended coordinates."""
    a, b = (p[1] - p[0]) * (q[1] - q[0]), (p[1] + p[0]) * (q[1] + q[0])
    c, d = 2 * p[3] * q[3] * D, 2 * p[2] * q[2]
    e, f, g, h = b - a, d - c, d + c, b + a
    return e * f % P, g * h % P, f * g % P, e * h % P


def times(n: int, p: tuple) -> tuple:
    """Multiply a point by a number."""
    total = (0, 1, 1, 0)
    while n:
        total, p, n = add(total, p) if n & 1 else total, add(p, p), n >> 1
    return total


def point(data: bytes) -> tuple:
    """Read a point. **Raises:** `ValueError` for bytes that are none."""
    y, sign = int.from_bytes(data, "little") % 2**255, data[31] >> 7
    square = (y * y - 1) * pow(D * y * y + 1, -1, P) % P
    x = pow(square, (P + 3) // 8, P)
    x = x if (x * x - square) % P == 0 else x * ROOT % P
    if (x * x - square) % P or y >= P or (sign and not x):
        raise ValueError("these bytes are no point of the curve")
    x = x if x & 1 == sign else P - x
    return x, y, 1, x * y % P


def is_signed(key: bytes, message: bytes, signature: bytes) -> bool:
    """Return whether a signature of a message is by the owner of a public key."""
    if (len(key), len(signature)) != (32, 64):
        return False
    base = point((4 * pow(5, -1, P) % P).to_bytes(32, "little"))
    s = int.from_bytes(signature[32:], "little")
    h = int.from_bytes(hashlib.sha512(signature[:32] + key + message).digest(), "little") % ORDER
    try:
        one, other = times(s, base), add(point(signature[:32]), times(h, point(key)))
    except ValueError:
        return False
    return s < ORDER and all((one[i] * other[2] - other[i] * one[2]) % P == 0 for i in (0, 1))


def message_of(manifest: dict) -> bytes:
    """Return the bytes that are signed: all entries but the signature."""
    said = {name: value for name, value in manifest.items() if name != "signature"}
    return json.dumps(said, sort_keys=True, separators=(",", ":")).encode()


def findings(path: str | os.PathLike[str], key: bytes) -> list[str]:
    """Return a sentence for each thing that is wrong with a manifest and its files."""
    folder = os.path.dirname(os.path.abspath(path))
    try:
        with open(path, "rb") as file:
            manifest = json.load(file)
        if not is_signed(key, message_of(manifest), bytes.fromhex(manifest["signature"])):
            return [f"{path} is not signed by the owner of this key, or was changed since"]
        signed = {entry["name"]: entry["sha256"] for entry in manifest["files"]}
        whole = manifest["folders"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        return [f"{path} is no signed manifest: {error!r}"]
    wrong = []
    for name, sha256 in signed.items():
        file = os.path.realpath(os.path.join(folder, name))
        if os.path.commonpath((file, os.path.realpath(folder))) != os.path.realpath(folder):
            wrong.append(f"{name} is outside of the folder of the manifest")
        elif not os.path.isfile(file):
            wrong.append(f"{name} is missing")
        else:
            with open(file, "rb") as opened:
                if hashlib.file_digest(opened, "sha256").hexdigest() != sha256:
                    wrong.append(f"{name} was changed")
    for top in whole:
        for at, _, names in os.walk(os.path.join(folder, top)):
            for file in sorted(os.path.join(at, name) for name in names):
                name = os.path.relpath(file, folder).replace(os.sep, "/")
                if name not in signed and name != os.path.basename(path):
                    wrong.append(f"{name} was added")
    return wrong


def read_key(text: str) -> bytes:
    """Read a public key: the file of a PEM, or hexadecimal digits."""
    if not os.path.isfile(text):
        return bytes.fromhex(text)
    with open(text, encoding="ascii") as file:
        lines = [line for line in file.read().splitlines() if line and "-----" not in line]
    return base64.b64decode("".join(lines))[-32:]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Check the signed manifest of a report.")
    parser.add_argument("manifest")
    parser.add_argument("--key", required=True, help="public key of the signer: PEM, or hex digits")
    given = parser.parse_args()
    problems = findings(given.manifest, read_key(given.key))
    print("\n".join(problems) or "The signature is of this key, and all files are as signed.")
    sys.exit(bool(problems))
