"""Encrypted connections between a run and its clients.

`localhost.pem` is a certificate for 127.0.0.1 that signed itself, valid until 2126, with its key,
which guards nothing; `localhost.crt` is the certificate alone, `other.crt` another one's.
"""

import socket
import ssl
import struct
import threading
from pathlib import Path

import numpy as np
import pytest

from verifai_jax.addons.simulators import remote_client
from verifai_jax.addons.simulators.remote._remote import remote
from verifai_jax.addons.simulators.remote.connection import Client
from verifai_jax.core.values.trace import Status

HERE = Path(__file__).parent
TOKEN = "a secret of the test"
LARGE = 60_000
"""Samples of a trace that fills many records of TLS."""


def simulate(features, seed):
    return {"x": features["a"] * np.ones(LARGE), "dt": 0.1}


def serve(system, certificate, **options):
    host, port = system.address
    remote_client.serve(
        simulate, host, port, TOKEN, reconnect=5.0, certificate=certificate, **options
    )


@pytest.fixture
def system():
    with remote(token=TOKEN, certificate=HERE / "localhost.pem") as system:
        yield system


def test_points_and_large_traces_go_through_an_encrypted_connection(system):
    clients = [
        threading.Thread(target=serve, args=(system, HERE / "localhost.crt"), daemon=True)
        for _ in range(2)
    ]
    for client in clients:
        client.start()
    features = [{"a": float(k), "text": "x" * 20_000} for k in range(40)]
    for index, outcome in system.simulate_each(features, range(40)):
        assert outcome.status == Status.OK, outcome.message
        np.testing.assert_array_equal(outcome.trace.signals["x"], index * np.ones(LARGE))


@pytest.mark.parametrize(
    ("certificate", "said"),
    [("other.crt", "the certificate of the server is not trusted: self"), ("system", "self")],
)
def test_a_client_refuses_a_certificate_that_it_does_not_trust(system, certificate, said):
    with pytest.raises(remote_client.Refused, match=said):
        serve(system, certificate if certificate == "system" else HERE / certificate)


def test_a_client_refuses_a_server_that_is_called_by_another_name(system):
    with pytest.raises(remote_client.Refused, match="localhost"):
        remote_client.serve(
            simulate, "localhost", system.address[1], TOKEN, certificate=HERE / "localhost.crt"
        )


def test_a_server_without_tls_is_named():
    with (
        remote(token=TOKEN) as system,
        pytest.raises(remote_client.Refused, match="speaks no TLS, so it needs no certificate"),
    ):
        serve(system, HERE / "localhost.crt")


def test_a_client_without_tls_is_told_what_is_missing(system, monkeypatch):
    monkeypatch.setattr(remote_client, "GREETING_SECONDS", 0.2)
    host, port = system.address
    with pytest.raises(ConnectionError, match="needs certificate="):
        remote_client.serve(simulate, host, port, TOKEN, reconnect=False)


def test_whoever_speaks_no_tls_harms_no_other(system):
    strangers = []
    broken = b"\x16\x03\x01" + bytes(300)
    for said in (b"", b"GET / HTTP/1.1\r\n\r\n", broken, struct.pack(">I", 9)):
        stranger = socket.create_connection(system.address, timeout=10)
        stranger.sendall(said)
        strangers.append(stranger)
    client = threading.Thread(target=serve, args=(system, HERE / "localhost.crt"), daemon=True)
    client.start()
    assert system({"a": 2.0}).signals["x"][0] == 2.0
    for stranger in strangers:
        stranger.close()


def test_a_handshake_that_waits_does_not_keep_the_server_busy():
    ours, theirs = socket.socketpair()
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(HERE / "localhost.pem")
    ours.setblocking(False)
    with (
        theirs,
        context.wrap_socket(ours, server_side=True, do_handshake_on_connect=False) as encrypted,
    ):
        client = Client(encrypted, ("127.0.0.1", 1))
        client.out += b"hello"
        client.flush()
        # What is to be sent waits for what the other side says first.
        assert client.out == b"hello"
        assert not client.waits_to_send
        assert client.receive() is None


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            {"certificate": "none.pem"},
            "certificate must be a PEM file; there is no file 'none.pem'",
        ),
        (
            {"certificate": HERE / "localhost.crt"},
            "not a certificate and its private key",
        ),
        ({"certificate": __file__}, "not a certificate and its private key"),
        ({"private_key": HERE / "localhost.pem"}, "private_key belongs to a certificate"),
    ],
)
def test_files_that_are_no_certificate_are_named(options, said):
    with pytest.raises(ValueError, match=said):
        remote(**options)


def test_a_file_that_is_no_certificate_is_named_to_a_client(capsys):
    assert remote_client.main(["--certificate", __file__, f"{__file__}:simulate"]) == 1
    assert "is not a certificate in a PEM file" in capsys.readouterr().err
