"""Simulators in other processes, languages and machines; a run sends them points over TCP.

    with remote(port=4567) as system:                    # and there: serve(simulate, port=4567)
        falsify(Problem("cars", space, system, "always x <= 2"))

    remote(host="0.0.0.0", port=4567, token=secret, certificate="run.pem")   # beyond this machine
    remote(signals=("x", "v"), dt=0.02, length=200)      # every trace is checked against these

`remote_client.py` is the other side in Python, and `docs/remote.md` the protocol for others.
"""

import ipaddress
import logging
import queue
import socket
import threading
import weakref
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar

from verifai_jax.addons.simulators.remote import wire
from verifai_jax.addons.simulators.remote.connection import Batch, File, Rules, server_context
from verifai_jax.addons.simulators.remote.server import Server
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.core.values.trace import Trace
from verifai_jax.systems.base import Features, Outcome, Seed, System
from verifai_jax.systems.blackbox._blackbox import plain_leaves, seed_of, single_trace
from verifai_jax.systems.blackbox.trace_form import SignalNames, TraceForm

log = logging.getLogger("verifai_jax.remote")
MAX_BYTES = 16 << 20
"""Bytes of one message of a client, unless `remote` is given another limit."""
MAX_MEMORY = 256 << 20
"""Bytes of unfinished messages of all clients together, unless `remote` is given another limit."""
LOOPBACKS = ("127.0.0.1", "::1")
"""Addresses of this machine, by IPv4 and IPv6."""


class Remote(System):
    """A host system that is simulated by other programs, the clients; made by `remote`.

    The port is opened when it is first needed, so defining one in a module has no effect yet.
    """

    black_box: ClassVar[bool] = True

    def __init__(self, host: str, port: int, rules: Rules) -> None:
        self.host, self.port, self.rules = host, port, rules
        self._lock = threading.Lock()
        self._server: Server | None = None

    def __repr__(self) -> str:
        return f"remote(host={self.host!r}, port={self.port})"

    @property
    def addresses(self) -> list[tuple[str, int]]:
        """The addresses at which clients can connect: host and port, one for each protocol."""
        return [sock.getsockname()[:2] for sock in self._open().listening]

    @property
    def address(self) -> tuple[str, int]:
        """The first of `addresses`."""
        return self.addresses[0]

    @property
    def clients(self) -> list[str]:
        """The names of the clients that are connected."""
        return [client.name for client in tuple(self._open().clients) if client.here]

    @property
    def workers(self) -> int:
        """Number of simulations that run in parallel: one for each connected client."""
        return max(1, len(self.clients))

    def abstract(self, features: Features) -> Trace | None:
        return self.rules.declared.abstract()

    def __call__(self, features: Features, key: Seed = None) -> Trace:
        """Simulate once, by any client.

        **Raises:** `RuntimeError`, `TimeoutError`: what went wrong there.
        """
        return single_trace(self.simulate_each([plain_leaves(features)], [seed_of(key)]))

    def simulate_each(
        self, features: Sequence[Features], seeds: Sequence[int]
    ) -> Iterator[tuple[int, Outcome]]:
        """Simulate each row on some client; see `System.simulate_each`.

        **Raises:** `TypeError` for features that JSON cannot hold; `ConnectionError` if the server
        is closed meanwhile.
        """
        texts = [_text(each, seed) for each, seed in zip(features, seeds, strict=True)]
        batch, server = Batch(), self._open()
        server.submit(batch, texts)
        try:
            for _ in texts:
                yield _next(batch, server)
        except KeyboardInterrupt:
            # What has come by now is not lost: the caller has it before the interruption goes on.
            while not batch.outcomes.empty():
                outcome = batch.outcomes.get()
                if not isinstance(outcome, BaseException):
                    yield outcome
            raise
        finally:
            batch.cancelled = True

    def close(self) -> None:
        """Disconnect the clients and close the port; the next simulation opens it again."""
        with self._lock:
            server, self._server = self._server, None
        if server is not None:
            server.stop()

    def __enter__(self) -> "Remote":
        self._open()
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _open(self) -> Server:
        with self._lock:
            if self._server is None or not self._server.is_alive():
                self._server = Server(self.rules, _listen(self.host, self.port))
                self._server.start()
                # Clients are told that the run has ended, not cut off, whoever forgot to close it.
                weakref.finalize(self, self._server.stop)
                where = " and ".join(
                    f"{s.getsockname()[0]} port {s.getsockname()[1]}"
                    for s in self._server.listening
                )
                log.info("simulators can connect to %s", where)
            return self._server


@suggests_options
def remote(
    host: str = "127.0.0.1",
    port: int = 0,
    *,
    token: str | None = None,
    certificate: File | None = None,
    private_key: File | None = None,
    timeout: float | None = 60.0,
    retries: int = 1,
    patience: float | None = None,
    signals: SignalNames | None = None,
    dt: float | None = None,
    length: int | None = None,
    max_bytes: int = MAX_BYTES,
    max_memory: int = MAX_MEMORY,
) -> Remote:
    """Make a system that is simulated by programs that connect to this process.

    **Arguments:**
    - `host`: the address to listen on; by default only this machine, `"localhost"` with IPv4 and
      IPv6. Any other address needs a token.
    - `port`: the port; 0 for any free one, see `Remote.address`.
    - `token`: a secret that clients have to send. Without one, every program that can connect on
      this machine may answer.
    - `certificate`: a PEM file with a certificate. Connections are then encrypted (TLS), and
      clients can verify that they reached this run; not encrypted when None.
    - `private_key`: a PEM file with the certificate's key, if `certificate` does not contain it.
    - `timeout`: wall-clock seconds for one simulation, after which it becomes a row with status
      `timeout` and its client is disconnected; None for no limit.
    - `retries`: how often a point is sent again if its client disconnects.
    - `patience`: seconds without any client after which the remaining points become rows with
      status `error`; by default it waits, and logs that it does.
    - `signals`, `dt`, `length`: the form of every trace; see `blackbox.TraceForm`. A client that
      sends another form gets an error, and the row has status `error`.
    - `max_bytes`: the maximum number of bytes of one message from a client.
    - `max_memory`: maximum bytes of unfinished messages of all clients together, at least
      `max_bytes`; beyond it the client with the oldest unfinished message is disconnected, and may
      reconnect.
    **Returns:** a `Remote`; it starts listening when it is needed, or in a `with` statement.
    **Raises:** `ValueError` for options out of range, an address beyond this machine without a
    token, and files that are not certificates; when it is first needed, `OSError` for a port in
    use.
    """
    if not isinstance(host, str) or not host:
        raise ValueError(f"host must be a name or an address, such as '127.0.0.1'; got {host!r}")
    if not isinstance(port, int) or isinstance(port, bool) or not 0 <= port < 65536:
        raise ValueError(f"port must be an integer from 0 to 65535; got {port!r}")
    if token is not None and (not isinstance(token, str) or not token.strip()):
        raise ValueError("token must be a text that is hard to guess; got an empty one")
    for name, value in (("timeout", timeout), ("patience", patience)):
        if value is not None and not (isinstance(value, int | float) and value > 0):
            raise ValueError(f"{name} must be a positive number of seconds; got {value!r}")
    check_count("retries", retries, 0)
    if not isinstance(max_bytes, int) or not 1024 <= max_bytes < 2**31:
        raise ValueError(f"max_bytes must be an integer from 1024 to 2**31 - 1; got {max_bytes}")
    if not isinstance(max_memory, int) or max_memory < max_bytes:
        raise ValueError(
            f"max_memory must be an integer of at least max_bytes={max_bytes}; got {max_memory}"
        )
    if token is None and not all(_is_loopback(address[4][0]) for address in _addresses(host, port)):
        raise ValueError(
            f"host {host!r} is open to other machines, and whoever connects answers for the "
            "simulator: give token='...', the same here and to the clients, or host='127.0.0.1'"
        )
    if private_key is not None and certificate is None:
        raise ValueError("private_key belongs to a certificate: give certificate='...', too")
    tls = None if certificate is None else server_context(certificate, private_key)
    declared = TraceForm(signals, dt, length)
    rules = Rules(token, timeout, retries, patience, max_bytes, declared, max_memory, tls)
    return Remote(host, port, rules)


def _text(features: Features, seed: int) -> bytes:
    """Return a point of a `work` message, its JSON after the id."""
    text = wire.to_text({"seed": int(seed), "features": wire.plain(features)})
    return text[1:].encode()


def _next(batch: Batch, server: Server) -> tuple[int, Outcome]:
    while True:
        try:
            outcome = batch.outcomes.get(timeout=1.0)
        except queue.Empty:
            if server.is_alive():
                continue
            raise ConnectionError("the server for remote simulators has ended") from None
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome


def _addresses(host: str, port: int) -> list[Any]:
    """Return the addresses that `host` resolves to, each once; both loopbacks for `localhost`."""
    addresses = []
    for name in LOOPBACKS if host == "localhost" else (host,):
        try:
            kind = socket.SOCK_STREAM
            resolved = socket.getaddrinfo(name, port, type=kind, flags=socket.AI_PASSIVE)
        except OSError as error:
            raise ValueError(f"host {host!r} is not an address of this machine: {error}") from error
        addresses += [p for p in resolved if p[4] not in [other[4] for other in addresses]]
    return addresses


def _is_loopback(address: str) -> bool:
    return ipaddress.ip_address(address.partition("%")[0]).is_loopback


def _listen(host: str, port: int) -> list[socket.socket]:
    """Open sockets at one port, one for each address of the host."""
    for attempt in range(10):
        opened: list[socket.socket] = []
        chosen = port
        try:
            for family, kind, _, _, address in _addresses(host, port):
                if host == "localhost" and family == socket.AF_INET6 and not _has_ipv6():
                    continue
                sock = socket.socket(family, kind)
                opened.append(sock)
                # A port is free again at once, not only when its last connections are forgotten.
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                if family == socket.AF_INET6:
                    sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
                sock.bind((address[0], chosen, *address[2:]))
                sock.listen(128)
                chosen = sock.getsockname()[1]
            return opened
        except OSError as error:
            for sock in opened:
                sock.close()
            if port == 0 and len(opened) > 1 and attempt < 9:
                continue  # The other protocol's port of this number is taken; another may not be.
            raise OSError(
                error.errno,
                f"simulators cannot connect at {host!r}, port {port}: {error.strerror}; another "
                "run may listen there. Give another port, or port=0 for any that is free",
            ) from error
    raise AssertionError


def _has_ipv6() -> bool:
    try:
        with socket.socket(socket.AF_INET6) as sock:
            sock.bind(("::1", 0))
    except OSError:
        return False
    return True
