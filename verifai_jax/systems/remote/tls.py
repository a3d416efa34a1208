"""Encryption of connections by TLS, with the certificate of this machine."""

import os
import ssl
from pathlib import Path

File = str | os.PathLike[str]


def server_context(certificate: File, private_key: File | None) -> ssl.SSLContext:
    """Return the settings of a server that shows a certificate.

    **Arguments:**

    - `certificate`: a PEM file with the certificate, and those between it and its authority.
    - `private_key`: a PEM file with its key; the same file when None. The key is not encrypted.

    **Raises:** `ValueError` for files that are not there, or hold no such thing.
    """
    for name, file in (("certificate", certificate), ("private_key", private_key)):
        if file is not None and not Path(file).is_file():
            raise ValueError(f"{name} must be a PEM file; there is no file {str(file)!r}")
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    key = certificate if private_key is None else private_key
    try:
        # Without a password here, OpenSSL would ask for one at the terminal.
        context.load_cert_chain(certificate, key, password="")
    except (ssl.SSLError, OSError) as error:
        raise ValueError(
            f"{str(certificate)!r} and {str(key)!r} are no certificate and its private key in PEM "
            f"form, without a password: {error}"
        ) from error
    return context
