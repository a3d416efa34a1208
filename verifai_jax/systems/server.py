"""The server thread of `remote`: who is connected, which point is where, and whose time is up.

Clients come and go while the run goes on: the points of one that vanishes go to others. One thread
owns all sockets and points, so that nothing is locked; the run's thread only puts points into its
inbox and takes outcomes from a queue. What goes over the wire is `wire`'s.
"""

import contextlib
import hashlib
import hmac
import itertools
import logging
import math
import queue
import secrets
import selectors
import socket
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from verifai_jax.systems import wire
from verifai_jax.systems.blackbox import Declared
from verifai_jax.systems.simulations import Outcome
from verifai_jax.trace import Status

log = logging.getLogger("verifai_jax.remote")

TICK = 0.1  # Seconds between two looks at the clock.
GREETING_SECONDS = 10.0
GREETING_BYTES = 4096  # Before it has proved its token, a client may not fill our memory.
LINGER_SECONDS = 2.0  # How long a client that is sent away has to read why.
# Seconds from a point to its result that make a client's window grow, or shrink: enough points wait
# at a fast one to keep it busy, and none at a slow one while others idle.
SWIFT, SLOW = 0.05, 0.2
MOST_FAULTS = 100
MOST_CLIENTS = 256
REMEMBERED = 4096  # Answered points that a client may answer again without being told off.
REMINDER = 10.0  # Seconds without a client until the log says so; then twice as long, up to 60.


@dataclass(frozen=True)
class Rules:
    """What a server demands of its clients; see `remote`."""

    token: str | None
    timeout: float | None
    retries: int
    patience: float | None
    most_bytes: int
    declared: Declared


@dataclass(eq=False)
class Batch:
    """The points of one call, whose outcomes go to the caller's thread."""

    outcomes: queue.SimpleQueue[Any] = field(default_factory=queue.SimpleQueue)
    cancelled: bool = False


@dataclass(eq=False)
class Point:
    """One simulation: where its outcome goes, and what has happened to it so far."""

    id: int
    batch: Batch
    index: int
    text: bytes
    losses: int = 0  # Clients that vanished while they simulated it,
    lost: float = 0.0  # and when the last one did.
    handed: float = 0.0
    ahead: int = 0  # Points that its client had to simulate before.


class Client:
    """One connection."""

    def __init__(self, sock: socket.socket, address: Any) -> None:
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
        self.capacity = self.parallel = self.window = 1
        self.has: dict[int, Point] = {}  # In the order in which they were handed out.
        self.answered: dict[int, None] = {}
        self.progress = 0.0  # When it last showed that it works.
        self.faults = 0

    @property
    def here(self) -> bool:
        """Whether points may be handed to it."""
        return self.greeted and not self.leaving

    @property
    def room(self) -> int:
        """How many more points it may have now."""
        return min(self.window, self.capacity) - len(self.has)

    def running(self) -> list[Point]:
        """The points that it is simulating now, if it goes by their order."""
        return list(itertools.islice(self.has.values(), self.parallel))

    def send(self, data: bytes) -> None:
        self.out += data

    def tell(self, message: str, number: int | None = None, fatal: bool = False) -> None:
        about = {"type": "error", "message": message, "id": number, "fatal": fatal}
        self.send(wire.frame(about))

    def flush(self) -> None:
        if self.out:
            try:
                sent = self.socket.send(self.out)
            except (BlockingIOError, InterruptedError):
                return
            del self.out[:sent]


class Server(threading.Thread):
    """The thread that owns all sockets and points."""

    def __init__(self, rules: Rules, listening: list[socket.socket]) -> None:
        super().__init__(name="verifai_jax.remote", daemon=True)
        self.rules, self.listening = rules, listening
        self.clients: set[Client] = set()
        self.waiting: deque[Point] = deque()
        self.lost: deque[Point] = deque()  # Those whose client vanished, for a client that works.
        self.batches: list[Batch] = []
        self._inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._wake, self._waker = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        self._ids = itertools.count(1)
        self._alone_since: float | None = None
        self._remind = REMINDER
        self._refused_until = 0.0
        for sock in (*listening, self._wake):
            sock.setblocking(False)
            self._selector.register(sock, selectors.EVENT_READ)

    # Called by other threads

    def submit(self, batch: Batch, texts: Sequence[bytes]) -> None:
        """Have these points simulated; each is `{"id":%d,...}` without its id."""
        self._tell((batch, texts))

    def stop(self) -> None:
        """Send all clients away and end the thread."""
        if self.is_alive():
            self._tell(None)
            self.join(timeout=5.0)

    def _tell(self, what: Any) -> None:
        self._inbox.put(what)
        # Otherwise it wakes up by itself, or it has ended and says so.
        with contextlib.suppress(OSError):
            self._waker.send(b"!")

    # The thread

    def run(self) -> None:
        """Serve until told to stop."""
        ended: BaseException = ConnectionError("the server for remote simulators was closed")
        try:
            self._loop()
        except BaseException as error:  # A defect here must not leave a run waiting for ever.
            log.exception("the server for remote simulators broke down")
            ended = error
        finally:
            self._close(ended)

    def _loop(self) -> None:
        ticked = 0.0
        while True:
            for key, events in self._selector.select(TICK):
                if key.fileobj is self._wake:
                    self._wake.recv(4096)
                elif key.data is None:
                    self._accept(key.fileobj)
                else:
                    self._attend(key.data, events)
            while not self._inbox.empty():
                told = self._inbox.get()
                if told is None:
                    return
                self._take_up(*told)
            self._hand_out()
            now = time.monotonic()
            if now - ticked >= TICK:
                ticked = now
                self._look_at_clock(now)

    def _close(self, ended: BaseException) -> None:
        for client in self.clients:
            with contextlib.suppress(OSError):
                client.send(wire.frame({"type": "bye"}))
                client.flush()
            client.socket.close()
        for sock in (*self.listening, self._wake, self._waker):
            sock.close()
        self._selector.close()
        while not self._inbox.empty():
            told = self._inbox.get()
            if told is not None:
                self.batches.append(told[0])
        for batch in self.batches:
            batch.outcomes.put(ended)

    def _take_up(self, batch: Batch, texts: Sequence[bytes]) -> None:
        self.batches = [known for known in self.batches if not known.cancelled]
        self.batches.append(batch)
        for index, text in enumerate(texts):
            number = next(self._ids)
            self.waiting.append(Point(number, batch, index, b'{"id":%d,%b' % (number, text)))

    # Connections

    def _accept(self, listening: Any) -> None:
        if time.monotonic() < self._refused_until:
            return
        try:
            sock, address = listening.accept()
        except (BlockingIOError, InterruptedError, ConnectionAbortedError):
            return
        except OSError as error:
            # No file left, most likely: try again when some have closed.
            log.warning("no further client can connect: %s", error)
            self._refused_until = time.monotonic() + 1.0
            return
        sock.setblocking(False)
        _keep_alive(sock)
        client = Client(sock, address)
        self.clients.add(client)
        self._selector.register(sock, selectors.EVENT_READ, client)
        if len(self.clients) > MOST_CLIENTS:
            self._send_away(client, f"there are {MOST_CLIENTS} clients already")
        else:
            client.send(wire.frame(self._hello(client)))
        self._flush(client)

    def _attend(self, client: Client, events: int) -> None:
        try:
            if events & selectors.EVENT_READ:
                data = client.socket.recv(1 << 18)
                if not data:
                    self._drop(client, "closed the connection")
                    return
                if not client.leaving:
                    self._read(client, data)
        except (BlockingIOError, InterruptedError):
            pass
        except wire.WireError as error:
            self._send_away(client, str(error))
        except OSError as error:
            self._drop(client, f"vanished ({error})")
            return
        except Exception as error:  # One client must never end the others.
            log.exception("a message of %s could not be handled", client.name)
            self._send_away(client, f"{type(error).__name__}: {error}")
        self._flush(client)

    def _flush(self, client: Client) -> None:
        if client not in self.clients:
            return
        try:
            client.flush()
        except OSError as error:
            self._drop(client, f"vanished ({error})")
            return
        if client.leaving and not client.out:
            # The rest of what it sends has to be read, or it would be reset before it reads why.
            with contextlib.suppress(OSError):
                client.socket.shutdown(socket.SHUT_WR)
        if client.writing != bool(client.out):
            client.writing = bool(client.out)
            wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if client.out else 0)
            self._selector.modify(client.socket, wanted, client)

    def _send_away(self, client: Client, why: str) -> None:
        """Tell a client why, and close the connection when it has had time to read it."""
        if client.leaving:
            return
        log.warning("simulator %s is sent away: %s", client.name, why)
        client.tell(why, fatal=True)
        self._release(client, "was sent away")
        client.leaving = True
        client.deadline = time.monotonic() + LINGER_SECONDS

    def _drop(self, client: Client, how: str) -> None:
        if client not in self.clients:
            return
        self.clients.discard(client)
        self._selector.unregister(client.socket)
        client.socket.close()
        if client.leaving:
            return
        level = logging.WARNING if client.has else logging.INFO
        unfinished = f" with {len(client.has)} points unfinished" if client.has else ""
        log.log(level, "simulator %s %s%s", client.name, how, unfinished)
        self._release(client, how)

    def _release(self, client: Client, how: str) -> None:
        """Give the points of a client to others, and count those against it that it worked on."""
        suspects = {point.id for point in client.running()}
        for point in reversed(client.has.values()):
            if point.id not in suspects:
                self.waiting.appendleft(point)
                continue
            point.losses += 1
            point.lost = time.monotonic()
            if point.losses <= self.rules.retries:
                self.lost.append(point)
                continue
            times = f" (attempt {point.losses} of {self.rules.retries + 1})"
            message = f"the simulator {client.name} {how} while it simulated this{times}"
            self._settle(point, Outcome(None, Status.ERROR, message))
        client.has.clear()

    # Messages

    def _read(self, client: Client, data: bytes) -> None:
        for message in client.frames.feed(data):
            match message.header["type"]:
                case "hello" if not client.greeted:
                    self._greet(client, message.header)
                case "result" if client.greeted:
                    self._take_back(client, message)
                case _ if not client.greeted:
                    raise wire.WireError("the first message of a client must be its hello")
                case kind:
                    raise wire.unknown_type(kind, ["result"])
            if client.leaving:
                return

    def _hello(self, client: Client) -> dict[str, Any]:
        declared = self.rules.declared
        return {
            "type": "hello",
            "protocol": wire.PROTOCOL,
            "challenge": None if self.rules.token is None else client.challenge,
            "most_bytes": self.rules.most_bytes,
            "signals": declared.widths or None,
            "dt": declared.dt,
            "length": declared.length,
        }

    def _greet(self, client: Client, hello: dict[str, Any]) -> None:
        if hello.get("protocol") != wire.PROTOCOL:
            spoken = wire.brief(hello.get("protocol"))
            raise wire.WireError(f"this server speaks protocol {wire.PROTOCOL}; got {spoken}")
        self._authenticate(client, hello)
        for name, most in (("capacity", 10_000), ("parallel", hello.get("capacity", 1))):
            value = hello.get(name, 1)
            if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= most:
                raise wire.WireError(
                    f"{name} must be an integer from 1 to {most}; got {wire.brief(value)}"
                )
            setattr(client, name, value)
        if isinstance(hello.get("name"), str):
            client.name = f"{wire.printable(hello['name'])} ({client.name})"
        client.window = client.parallel
        client.greeted, client.deadline = True, math.inf
        client.frames.most = self.rules.most_bytes
        log.info("simulator %s is here", client.name)

    def _authenticate(self, client: Client, hello: dict[str, Any]) -> None:
        token = self.rules.token
        if token is None:
            return
        if "proof" in hello:
            right = hmac.new(token.encode(), client.challenge.encode(), hashlib.sha256).hexdigest()
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

    def _take_back(self, client: Client, message: wire.Message) -> None:
        now, number = time.monotonic(), message.header.get("id")
        client.progress = now
        point = client.has.get(number) if isinstance(number, int) else None
        if point is None:
            if isinstance(number, int) and number in client.answered:
                log.debug("simulator %s answered point %d again", client.name, number)
            else:
                self._blame(client, f"no point {wire.brief(number)} was handed to this client")
            return
        problem = message.header.get("error")
        if problem is not None:
            outcome = Outcome(None, Status.ERROR, wire.printable(problem, 2000))
        else:
            try:
                outcome = Outcome(self.rules.declared.accept(wire.trace_of(message)))
            except (ValueError, TypeError) as error:
                outcome = Outcome(None, Status.ERROR, str(error))
                self._blame(client, str(error), point.id)
        del client.has[point.id]
        client.answered[point.id] = None
        if len(client.answered) > REMEMBERED:
            del client.answered[next(iter(client.answered))]
        taken = now - point.handed
        if taken < SWIFT:
            client.window = min(client.window + 1, client.capacity)
        elif taken > SLOW:
            client.window = max(client.window - 1, client.parallel)
        self._settle(point, outcome)

    def _blame(self, client: Client, what: str, number: int | None = None) -> None:
        """Tell a client of a fault that concerns one result only."""
        about = "" if number is None else f" (point {number})"
        log.warning("simulator %s%s: %s", client.name, about, what)
        client.faults += 1
        if client.faults > MOST_FAULTS:
            raise wire.WireError(f"more than {MOST_FAULTS} results were wrong; the last: {what}")
        client.tell(what, number)

    def _settle(self, point: Point, outcome: Outcome) -> None:
        if not point.batch.cancelled:
            point.batch.outcomes.put((point.index, outcome))

    # Points

    def _hand_out(self) -> None:
        if not (self.waiting or self.lost) or not self._free():
            return
        self._hand_out_lost()
        while self.waiting and (free := self._free()):
            share = -(-len(self.waiting) // len(free))
            for client in free:
                self._hand(client, self.waiting, min(share, client.room))

    def _hand_out_lost(self) -> None:
        """Points whose client vanished: to one that has answered, or was here already.

        A client that dies of everything, and comes back at once, must not use up the attempts of
        every point; so a lost point waits for a better one, if there is any.
        """
        points, self.lost = self.lost, deque()
        for point in points:
            able = [
                client
                for client in self.clients
                if client.here and (client.answered or client.since < point.lost)
            ]
            free = [client for client in (able or self._free()) if client.room > 0]
            if free:
                self._hand(free[0], deque([point]), 1)
            else:
                self.lost.append(point)

    def _free(self) -> list[Client]:
        return [client for client in self.clients if client.here and client.room > 0]

    def _hand(self, client: Client, points: deque[Point], most: int) -> None:
        now, texts = time.monotonic(), []
        while points and len(texts) < most:
            point = points.popleft()
            if point.batch.cancelled:
                continue
            if not client.has:
                client.progress = now
            point.handed, point.ahead = now, len(client.has)
            client.has[point.id] = point
            texts.append(point.text)
        if texts:
            client.send(wire.frame(b'{"type":"work","points":[' + b",".join(texts) + b"]}"))
            self._flush(client)

    # The clock

    def _look_at_clock(self, now: float) -> None:
        for client in list(self.clients):
            if now > client.deadline:
                if client.leaving:
                    self._drop(client, "")
                else:
                    self._send_away(client, f"no hello came within {GREETING_SECONDS:g} s")
                    self._flush(client)
            elif self.rules.timeout is not None and client.has:
                self._look_for_overdue(client, now, self.rules.timeout)
        self._look_for_clients(now)

    def _look_for_overdue(self, client: Client, now: float, timeout: float) -> None:
        running = client.running()
        if now - client.progress > timeout:
            # It shows no progress, so all that it is simulating takes too long.
            overdue = [point for point in running if now - point.handed > timeout]
        else:
            # Others come in meanwhile; each had this long, and those before it as long.
            overdue = [
                point
                for point in running
                if now - point.handed > timeout * (1 + point.ahead // client.parallel)
            ]
        if not overdue:
            return
        for point in overdue:
            del client.has[point.id]
            message = f"the simulation took longer than {timeout:g} s at {client.name}"
            self._settle(point, Outcome(None, Status.TIMEOUT, message))
        # What else it simulates at the moment is no suspect, but it will not be answered here.
        for point in reversed(client.has.values()):
            self.waiting.appendleft(point)
        client.has.clear()
        ids = ", ".join(str(point.id) for point in overdue)
        self._send_away(client, f"point {ids} took longer than {timeout:g} s")
        self._flush(client)

    def _look_for_clients(self, now: float) -> None:
        here = any(client.here for client in self.clients)
        wanted = any(not p.batch.cancelled for p in itertools.chain(self.waiting, self.lost))
        if here or not wanted:
            self._alone_since, self._remind = None, REMINDER
            return
        if self._alone_since is None:
            self._alone_since = now
        alone, patience = now - self._alone_since, self.rules.patience
        if patience is not None and alone > patience:
            message = f"no simulator was connected for {patience:g} s"
            log.warning("%s: %d points are given up", message, len(self.waiting) + len(self.lost))
            for point in itertools.chain(self.lost, self.waiting):
                self._settle(point, Outcome(None, Status.ERROR, message))
            self.waiting.clear()
            self.lost.clear()
        elif alone > self._remind:
            self._remind += min(self._remind, 60.0)
            host, port = self.listening[0].getsockname()[:2]
            log.warning(
                "no simulator has connected to %s for %.0f s; start one with "
                "`python -m verifai_jax.remote_client --address %s MODULE:FUNCTION`",
                (host, port),
                alone,
                f"[{host}]:{port}" if ":" in host else f"{host}:{port}",
            )


def _keep_alive(sock: socket.socket) -> None:
    """Let the system notice a peer whose machine is gone, within half a minute."""
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    # Not every system has each of them.
    for name, value in (("TCP_KEEPIDLE", 10), ("TCP_KEEPINTVL", 5), ("TCP_KEEPCNT", 3)):
        if hasattr(socket, name):
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
    if hasattr(socket, "TCP_USER_TIMEOUT"):
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 25_000)
