"""The server thread of `remote`: its clients, the points that each of them has, and timeouts.

If a client disappears, its points go to others. One thread owns all sockets and points, so no locks
are needed; the run's thread only puts points into its inbox and takes outcomes from a queue.
"""

import contextlib
import itertools
import logging
import math
import queue
import selectors
import socket
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Any

from verifai_jax.addons.simulators.remote import connection, wire
from verifai_jax.addons.simulators.remote.connection import (
    Absence,
    Batch,
    Client,
    Point,
    Rules,
    keep_alive,
)
from verifai_jax.core.values.trace import Status
from verifai_jax.systems.base import Outcome

log = logging.getLogger("verifai_jax.remote")
TICK = 0.1
"""Seconds between two checks of timeouts."""
MAX_LOGGED = 20
"""Faults of one client that are logged."""
MAX_UNREAD = 1 << 20
"""Bytes that a client may leave unread while it gives cause for more."""
UNCOUNTED = 1 << 16
"""Bytes that a client may hold without that those of all are counted."""
MAX_CLIENTS = 256
"""Clients that may be connected at a time."""
REMEMBERED = 1 << 16
"""Simulations whose clients are remembered."""


class Server(threading.Thread):
    """The thread that owns all sockets and points."""

    def __init__(self, rules: Rules, listening: list[socket.socket]) -> None:
        super().__init__(name="verifai_jax.remote", daemon=True)
        self.rules, self.listening = rules, listening
        self.clients: set[Client] = set()
        self.waiting: deque[Point] = deque()
        self._seen: dict[int, str] = {}  # Which client has simulated what last.
        self.lost: deque[Point] = deque()  # Those whose client vanished, for a client that works.
        self.batches: list[Batch] = []
        self._inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._wake, self._waker = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        self._ids = itertools.count(1)
        self._absence = Absence()
        self._refused_until = 0.0
        for sock in (*listening, self._wake):
            sock.setblocking(False)
            self._selector.register(sock, selectors.EVENT_READ)

    # Called by other threads

    def submit(self, batch: Batch, texts: Sequence[bytes]) -> None:
        """Queue these points for simulation; each is `{"id":%d,...}` without its id."""
        self._tell((batch, texts))

    def stop(self) -> None:
        """Disconnect all clients and end the thread."""
        if self.is_alive():
            self._tell(None)
            # Garbage is collected in any thread, in this one, too.
            if threading.current_thread() is not self:
                self.join(timeout=5.0)

    def _tell(self, what: tuple[Batch, Sequence[bytes]] | None) -> None:
        self._inbox.put(what)
        # Otherwise it wakes up by itself, or it has ended and says so.
        with contextlib.suppress(OSError):
            self._waker.send(b"!")

    # The thread

    def run(self) -> None:
        """Serve until `stop` is called."""
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
                request = self._inbox.get()
                if request is None:
                    return
                self._take_up(*request)
            self._hand_out()
            now = time.monotonic()
            if now - ticked >= TICK:
                ticked = now
                self._look_at_clock(now)

    def _close(self, ended: BaseException) -> None:
        for client in self.clients:
            with contextlib.suppress(OSError):
                client.out += wire.frame({"type": "bye"})
                client.flush()
            client.socket.close()
        for sock in (*self.listening, self._wake, self._waker):
            sock.close()
        self._selector.close()
        while not self._inbox.empty():
            request = self._inbox.get()
            if request is not None:
                self.batches.append(request[0])
        for batch in self.batches:
            batch.outcomes.put(ended)

    def _take_up(self, batch: Batch, texts: Sequence[bytes]) -> None:
        self.batches = [known for known in self.batches if not known.cancelled]
        self.batches.append(batch)
        for index, text in enumerate(texts):
            number = next(self._ids)
            message = b'{"id":%d,%b' % (number, text)
            self.waiting.append(Point(number, batch, index, message, hash(text)))

    # Connections

    def _accept(self, listening: Any) -> None:
        if time.monotonic() < self._refused_until:
            time.sleep(0.01)  # The socket stays ready until the connection is accepted.
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
        try:
            sock.setblocking(False)
            keep_alive(sock)
            if self.rules.tls is not None:
                # The two agree on keys while the first bytes are sent.
                sock = self.rules.tls.wrap_socket(
                    sock, server_side=True, do_handshake_on_connect=False
                )
        except OSError:  # It is gone already.
            sock.close()
            return
        if len(self.clients) >= MAX_CLIENTS:
            self._make_room()
        full = len(self.clients) >= MAX_CLIENTS
        client = Client(sock, address)
        self.clients.add(client)
        self._selector.register(sock, selectors.EVENT_READ, client)
        if full:
            self._send_away(client, f"there are {MAX_CLIENTS} clients already", retry=True)
        else:
            client.hello(self.rules)
        self._flush(client)

    def _make_room(self) -> None:
        """Drop the oldest connection that says nothing, which must not shut out those that do."""
        others = [client for client in self.clients if not client.here]
        if others:
            oldest = min(others, key=lambda client: client.since)
            self._drop(oldest, "was dropped in favour of another one, as it had not sent hello")

    def _bound_memory(self) -> None:
        """Disconnect clients with the oldest unfinished messages while all hold too much."""
        while sum(client.held for client in self.clients) > self.rules.max_memory:
            client = min(self.clients, key=lambda client: (client.began, -client.held))
            # It may be as honest as the others, so its points have lost nothing but time.
            self.waiting.extendleft(reversed(client.has.values()))
            client.has.clear()
            why = f"messages of all clients hold more than {self.rules.max_memory} bytes"
            if client.leaving or len(client.out) > MAX_UNREAD:
                self._drop(client, f"was dropped: {why}")
            else:
                self._send_away(client, why, retry=True)
                self._flush(client)

    def _attend(self, client: Client, events: int) -> None:
        try:
            if events & selectors.EVENT_READ or client.reads_after_sending:
                data = client.receive()
                if data == b"":
                    self._drop(client, "closed the connection")
                    return
                if data and not client.leaving:
                    self._read(client, data)
                    if client.held > UNCOUNTED:
                        self._bound_memory()
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
        if client.writing != client.waits_to_send:
            client.writing = client.waits_to_send
            wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if client.writing else 0)
            self._selector.modify(client.socket, wanted, client)

    def _send_away(self, client: Client, why: str, retry: bool = False) -> None:
        """Tell a client why, and close the connection when it has had time to read it.

        **Arguments:**
        - `retry`: whether it may come back.
        """
        if client.leaving:
            return
        why = wire.printable(why, 1000)
        log.warning("simulator %s is disconnected: %s", client.name, why)
        client.tell(why, fatal=True, retry=retry)
        self._release(client, "was disconnected")
        client.leaving = True
        client.frames, client.began = wire.Frames(0), math.inf
        client.deadline = time.monotonic() + connection.LINGER_SECONDS

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
        """Give a client's points to others, and count its loss of those that it was simulating."""
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
            client.began = math.inf
            match message.header["type"]:
                case "hello" if not client.greeted:
                    client.greet(message.header, self.rules)
                    log.info("simulator %s has connected", client.name)
                case "result" if client.greeted:
                    self._take_back(client, message)
                case _ if not client.greeted:
                    raise wire.WireError("the first message of a client must be its hello")
                case kind:
                    raise wire.unknown_type(kind, ["result"])
            if client.leaving:
                return
        if len(client.frames):
            client.began = min(client.began, time.monotonic())

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
        problem, wrong = message.header.get("error"), ""
        if problem is not None:
            outcome = Outcome(None, Status.ERROR, wire.printable(problem, 2000))
        else:
            try:
                outcome = Outcome(self.rules.declared.accept(wire.trace_of(message)))
            except (ValueError, TypeError) as error:
                wrong = wire.printable(str(error), 1000)
                outcome = Outcome(None, Status.ERROR, wrong)
        client.done(point, now)
        self._settle(point, outcome)
        if wrong:
            self._blame(client, wrong, point.id)

    def _blame(self, client: Client, what: str, number: int | None = None) -> None:
        """Tell a client of a fault that concerns one result only."""
        client.faults += 1
        if client.faults <= MAX_LOGGED:
            about = "" if number is None else f" (point {number})"
            last = "; further errors of it are not logged" if client.faults == MAX_LOGGED else ""
            log.warning("simulator %s%s: %s%s", client.name, about, what, last)
        if len(client.out) > MAX_UNREAD:
            raise wire.WireError("it does not read the errors sent to it")
        client.tell(what, number)

    def _settle(self, point: Point, outcome: Outcome) -> None:
        if not point.batch.cancelled:
            point.batch.outcomes.put((point.index, outcome))

    # Points

    def _hand_out(self) -> None:
        if not (self.waiting or self.lost) or not self._free():
            return
        self._hand_out_lost()
        handed = True
        while handed and self.waiting and (free := self._free()):
            share, handed = -(-len(self.waiting) // len(free)), False
            for client in free:
                handed |= self._hand(client, self.waiting, min(share, client.room))

    def _hand_out_lost(self) -> None:
        """Hand points whose client vanished to one that has answered, or was here already.

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

    def _hand(self, client: Client, points: deque[Point], maximum: int) -> bool:
        """Hand points to a client; return whether any left the queue.

        What it has simulated before is left to another one, where there is one: a simulation that
        is repeated shall not find what the first one left behind.
        """
        others = points is self.waiting and any(
            other.here and other is not client for other in self.clients
        )
        handed, left, before = [], [], len(points)
        while points and len(handed) < maximum:
            point = points.popleft()
            if point.batch.cancelled:
                continue
            if others and self._seen.get(point.what) == client.name:
                left.append(point)
                continue
            self._seen.pop(point.what, None)
            self._seen[point.what] = client.name
            handed.append(point)
        points.extendleft(reversed(left))
        while len(self._seen) > REMEMBERED:
            del self._seen[next(iter(self._seen))]
        if handed:
            client.hand(handed, time.monotonic())
            self._flush(client)
        return len(points) < before

    # The clock

    def _look_at_clock(self, now: float) -> None:
        for client in list(self.clients):
            if now > client.deadline:
                if client.leaving:
                    self._drop(client, "")
                else:
                    why = f"no hello came within {connection.GREETING_SECONDS:zg} s"
                    self._send_away(client, why)
                    self._flush(client)
            elif self.rules.timeout is not None and (
                overdue := client.overdue(now, self.rules.timeout)
            ):
                self._end_overdue(client, overdue)
        self._look_for_clients(now)

    def _end_overdue(self, client: Client, overdue: list[Point]) -> None:
        took = f"took longer than {self.rules.timeout:zg} s"
        for point in overdue:
            del client.has[point.id]
            message = f"the simulation {took} at {client.name}"
            self._settle(point, Outcome(None, Status.TIMEOUT, message))
        # What else it simulates at the moment is no suspect, but it will not be answered here.
        self.waiting.extendleft(reversed(client.has.values()))
        client.has.clear()
        self._send_away(client, f"point {', '.join(str(point.id) for point in overdue)} {took}")
        self._flush(client)

    def _look_for_clients(self, now: float) -> None:
        here = any(client.here for client in self.clients)
        wanted = any(not p.batch.cancelled for p in itertools.chain(self.waiting, self.lost))
        if here or not wanted:
            self._absence.end()
            return
        alone, patience = self._absence.seconds(now), self.rules.patience
        if patience is not None and alone > patience:
            message = f"no simulator was connected for {patience:zg} s"
            log.warning("%s: %d points are given up", message, len(self.waiting) + len(self.lost))
            for point in itertools.chain(self.lost, self.waiting):
                self._settle(point, Outcome(None, Status.ERROR, message))
            self.waiting.clear()
            self.lost.clear()
        else:
            self._absence.remind(alone, *self.listening[0].getsockname()[:2])
