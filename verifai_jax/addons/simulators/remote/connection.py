"""One client of the server: its hello, its points, and the bytes that wait to be sent to it.

Nothing here blocks: bytes wait in a buffer until the socket accepts them. `Absence` counts the time
without a client, and `server_context` encrypts connections by TLS.
"""

import hashlib
import hmac
import itertools
import logging
import math
import os
import queue
import secrets
import socket
import ssl
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from verifai_jax.addons.simulators.remote import wire
from verifai_jax.systems.blackbox.trace_form import TraceForm

GREETING_SECONDS = 10.0
"""Seconds within which a client must send its hello."""
GREETING_BYTES = 4096
"""Bytes of a hello: before it has proved its token, a client must not fill the memory."""
LINGER_SECONDS = 2.0
"""Seconds that a client has to read why it is sent away."""
SWIFT, SLOW = 0.05, 0.2
"""Seconds from a point to its result below which a client's window grows, and above which it
shrinks: enough points wait at a fast client to keep it busy, and none at a slow one while others
are idle."""
WORK_BYTES = 1 << 18
"""Bytes of a message of points from which the others go into another one."""
RECEIVED_BYTES = 1 << 18
"""Bytes that are read at a time."""
REMEMBERED = 4096
"""Answered points that a client may answer again without an error."""


@dataclass(frozen=True)
class Rules:
    """The requirements of a server on its clients; see `remote`."""

    token: str | None
    timeout: float | None
    retries: int
    patience: float | None
    max_bytes: int
    declared: TraceForm
    max_memory: int
    tls: ssl.SSLContext | None = None


@dataclass(eq=False)
class Batch:
    """The points of one call, whose outcomes are passed to the caller's thread."""

    outcomes: queue.SimpleQueue[Any] = field(default_factory=queue.SimpleQueue)
    cancelled: bool = False


@dataclass(eq=False)
class Point:
    """One simulation: its outcome, once known, and its history so far.

    `what` identifies its features and seed: equal numbers mean equal simulations.
    """

    id: int
    batch: Batch
    index: int
    text: bytes
    what: int
    losses: int = 0  # Clients that vanished while they simulated it,
    lost: float = 0.0  # and when the last one did.
    handed: float = 0.0
    ahead: int = 0  # Points that its client had to simulate before.


class Client:
    """One connection to a client."""

    def __init__(
        self, sock: socket.socket, address: tuple[str, int] | tuple[str, int, int, int]
    ) -> None:
        self.socket = sock
        self.name = f"{address[0]}:{address[1]}"
        self.frames = wire.Frames(GREETING_BYTES)
        self.challenge = secrets.token_hex(16)
        self.greeted = False
        self.leaving = False  # It is sent away: what it says is not read any more.
        self.since = time.monotonic()
        self.deadline = self.since + GREETING_SECONDS
        self.out = bytearray()
        self.writing = False  # Whether the selector waits for room to send.
        # With TLS a side may have to hear of the other before it can send, and the other way round.
        self._sends_after_reading = self.reads_after_sending = False
        self.capacity = self.parallel = self.window = 1
        self.has: dict[int, Point] = {}  # In the order in which they were handed out.
        self.answered: dict[int, None] = {}
        self.progress = 0.0  # When it last showed that it works.
        self.faults = 0
        self.began = math.inf  # When its unfinished message began.

    @property
    def held(self) -> int:
        """Number of buffered bytes: of an unfinished message, and of data that are not sent yet."""
        return len(self.frames) + len(self.out)

    @property
    def here(self) -> bool:
        """True if points may be sent to it."""
        return self.greeted and not self.leaving

    @property
    def room(self) -> int:
        """Number of further points that it can take now."""
        return min(self.window, self.capacity) - len(self.has)

    def running(self) -> list[Point]:
        """Return the points that it is simulating now, if it answers in order."""
        return list(itertools.islice(self.has.values(), self.parallel))

    def hello(self, rules: Rules) -> None:
        """Tell the client the requirements."""
        about = {
            "type": "hello",
            "protocol": wire.PROTOCOL,
            "challenge": None if rules.token is None else self.challenge,
            "max_bytes": rules.max_bytes,
            "signals": rules.declared.widths or None,
            "dt": rules.declared.dt,
            "length": rules.declared.length,
        }
        self.out += wire.frame(about)

    def greet(self, hello: dict[str, Any], rules: Rules) -> None:
        """Process the client's greeting: its capacity, name and token.

        **Raises:** `WireError` for a client that cannot be used, or that sends a wrong token.
        """
        if hello.get("protocol") != wire.PROTOCOL:
            spoken = wire.brief(hello.get("protocol"))
            raise wire.WireError(f"this server speaks protocol {wire.PROTOCOL}; got {spoken}")
        self._authenticate(hello, rules.token)
        for name, maximum in (("capacity", 10_000), ("parallel", hello.get("capacity", 1))):
            value = hello.get(name, 1)
            if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= maximum:
                raise wire.WireError(
                    f"{name} must be an integer from 1 to {maximum}; got {wire.brief(value)}"
                )
            setattr(self, name, value)
        if isinstance(hello.get("name"), str):
            self.name = f"{wire.printable(hello['name'])} ({self.name})"
        self.window = self.parallel
        self.greeted, self.deadline = True, math.inf
        self.frames.max_bytes = rules.max_bytes

    def _authenticate(self, hello: dict[str, Any], token: str | None) -> None:
        if token is None:
            return
        if "proof" in hello:
            right = hmac.new(token.encode(), self.challenge.encode(), hashlib.sha256).hexdigest()
            given = hello["proof"]
        elif "token" in hello:
            right, given = token, hello["token"]
        else:
            raise wire.WireError("this server needs a token: give it, or a proof of it, in hello")
        # In constant time, so that nobody learns a token letter by letter.
        if not isinstance(given, str) or not hmac.compare_digest(
            given.encode(errors="replace"), right.encode()
        ):
            raise wire.WireError("the token is wrong")

    def hand(self, points: list[Point], now: float) -> None:
        """Send points to the client to simulate."""
        for point in points:
            if not self.has:
                self.progress = now
            point.handed, point.ahead = now, len(self.has)
            self.has[point.id] = point
        texts: list[bytes] = []
        for last, point in enumerate(points, 1 - len(points)):
            texts.append(point.text)
            if last == 0 or sum(map(len, texts)) > WORK_BYTES:
                self.out += wire.frame(b'{"type":"work","points":[' + b",".join(texts) + b"]}")
                texts = []

    def done(self, point: Point, now: float) -> None:
        """Remove a point that the client has answered."""
        del self.has[point.id]
        self.answered[point.id] = None
        if len(self.answered) > REMEMBERED:
            del self.answered[next(iter(self.answered))]
        taken = now - point.handed
        if taken < SWIFT:
            self.window = min(self.window + 1, self.capacity)
        elif taken > SLOW:
            self.window = max(self.window - 1, self.parallel)

    def overdue(self, now: float, timeout: float) -> list[Point]:
        """Return the points whose simulation exceeds the timeout."""
        running = self.running()
        if now - self.progress > timeout:
            # It shows no progress, so all that it is simulating takes too long.
            return [point for point in running if now - point.handed > timeout]
        # Others come in meanwhile; each had this long, and those before it as long.
        return [
            point
            for point in running
            if now - point.handed > timeout * (1 + point.ahead // self.parallel)
        ]

    def tell(
        self, message: str, number: int | None = None, fatal: bool = False, retry: bool = False
    ) -> None:
        """Send the client an error; with `retry`, an error that may vanish at the next attempt."""
        about = {"type": "error", "message": message, "id": number, "fatal": fatal}
        if retry:
            about["retry"] = True
        self.out += wire.frame(about)

    @property
    def waits_to_send(self) -> bool:
        """True if there is data to send, which waits for the socket."""
        return (bool(self.out) and not self._sends_after_reading) or self.reads_after_sending

    def receive(self) -> bytes | None:
        """Return received bytes; empty at the end of the connection, None if nothing has arrived.

        **Raises:** `OSError` if the client has disconnected.
        """
        self.reads_after_sending = False
        try:
            data = self.socket.recv(RECEIVED_BYTES)
            # What OpenSSL has decrypted already, no selector sees.
            while data and isinstance(self.socket, ssl.SSLSocket) and self.socket.pending():
                data += self.socket.recv(RECEIVED_BYTES)
        except (BlockingIOError, InterruptedError, ssl.SSLWantReadError):
            return None
        except ssl.SSLWantWriteError:
            self.reads_after_sending = True
            return None
        return data

    def flush(self) -> None:
        """Send as much as the socket accepts.

        **Raises:** `OSError` if the client has disconnected.
        """
        self._sends_after_reading = False
        if self.out:
            try:
                sent = self.socket.send(self.out)
            except (BlockingIOError, InterruptedError, ssl.SSLWantWriteError):
                return
            except ssl.SSLWantReadError:
                self._sends_after_reading = True
                return
            del self.out[:sent]


def keep_alive(sock: socket.socket) -> None:
    """Make the operating system detect within half a minute that a peer's machine is gone."""
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    # Not every system has each of them.
    for name, value in (("TCP_KEEPIDLE", 10), ("TCP_KEEPINTVL", 5), ("TCP_KEEPCNT", 3)):
        if hasattr(socket, name):
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
    if hasattr(socket, "TCP_USER_TIMEOUT"):
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 25_000)


log = logging.getLogger("verifai_jax.remote")
REMINDER = 10.0
"""Seconds without a client until the log says so; then twice as long, up to 60."""


class Absence:
    """The time since the last client disconnected; the log reports it now and then."""

    def __init__(self) -> None:
        self.since: float | None = None
        self._next = REMINDER

    def end(self) -> None:
        """Record that a client is connected, or that no client is needed."""
        self.since, self._next = None, REMINDER

    def seconds(self, now: float) -> float:
        """Return for how many seconds no client has been connected."""
        if self.since is None:
            self.since = now
        return now - self.since

    def remind(self, seconds: float, host: str, port: int) -> None:
        """Log which client to start, if it is time for a reminder."""
        if seconds <= self._next:
            return
        self._next += min(self._next, 60.0)
        log.warning(
            "no simulator has connected to %s for %.0f s; start one with "
            "`python -m verifai_jax.addons.simulators.remote_client --address %s MODULE:FUNCTION`",
            (host, port),
            seconds,
            f"[{host}]:{port}" if ":" in host else f"{host}:{port}",
        )


File = str | os.PathLike[str]


def server_context(certificate: File, private_key: File | None) -> ssl.SSLContext:
    """Return the TLS settings of a server with a certificate.

    **Arguments:**
    - `certificate`: a PEM file with the certificate, and intermediate ones.
    - `private_key`: a PEM file with its key, not encrypted; the same file when None.
    **Raises:** `ValueError` for files that do not exist, or contain no certificate or key.
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
            f"{str(certificate)!r} and {str(key)!r} are not a certificate and its private key in "
            f"PEM form, without a password: {error}"
        ) from error
    return context
