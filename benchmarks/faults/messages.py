"""Hostile messages to a server of remote simulators, beside four honest clients.

What must hold: every simulation of the honest clients comes back once, with its own value; whoever
knows no token gets no point, and who knows it and sends garbage has that as its rows' message; the
server answers new clients at once, and its memory stays bounded.
"""

import contextlib
import hashlib
import hmac
import json
import random
import resource
import socket
import struct
import threading
from collections.abc import Iterator

import numpy as np

from benchmarks.faults.cases import Broken, chance
from verifai_jax.addons.simulators import remote_client
from verifai_jax.addons.simulators.remote._remote import Remote, remote
from verifai_jax.core.values.trace import Status

TOKEN = "a secret of the fuzzer"
CLIENTS = 4
POINTS = 6
"""Honest simulations beside each hostile connection."""
MAX_MEMORY_GB = 1.0
"""Resident memory by which this process may grow: 256 MiB of messages, and what Python adds."""


def simulate(features, seed):
    """An honest simulator: its one signal is its feature."""
    return {"x": np.full(3, features["a"]), "dt": 0.1}


class Fire:
    """A server with honest clients, and one hostile connection after the other."""

    def __init__(self, system: Remote) -> None:
        self.system = system
        self._open: list[socket.socket] = []
        self._memory = _memory()
        for _ in range(CLIENTS):
            threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        with contextlib.suppress(ConnectionError):
            remote_client.serve(simulate, *self.system.address, token=TOKEN, reconnect=5.0)

    def case(self, number: int) -> str:
        """Attack once. **Returns:** what kind of attack it was."""
        random_ = chance(number, "messages")
        insider = random_.random() < 0.25
        with contextlib.suppress(OSError):  # The server may have closed the connection meanwhile.
            self._attack(random_, insider)
        features = [{"a": float(number * POINTS + k)} for k in range(POINTS)]
        seen = set()
        for index, outcome in self.system.simulate_each(features, [0] * POINTS):
            seen.add(index)
            if outcome.status == Status.OK:
                if np.any(outcome.trace.signals["x"] != features[index]["a"]):
                    raise Broken(f"row {index} has the value of another")
            elif not insider or not outcome.message:
                raise Broken(f"row {index} of an honest client: {outcome.message!r}")
        if seen != set(range(POINTS)):
            raise Broken(f"only rows {sorted(seen)} came back")
        if _memory() - self._memory > MAX_MEMORY_GB:
            raise Broken(f"the process has grown by {_memory() - self._memory:.1f} GB")
        return "by a client with the token" if insider else "by a stranger"

    def _attack(self, random_: random.Random, insider: bool) -> None:
        hostile = socket.create_connection(self.system.address, timeout=5.0)
        self._open.append(hostile)
        if random_.random() < 0.3:
            for old in self._open[:-50]:  # Some stay open, and say nothing more.
                old.close()
            del self._open[:-50]
        if insider:
            hello = json.loads(_received(hostile))
            proof = hmac.new(TOKEN.encode(), hello["challenge"].encode(), hashlib.sha256)
            greeting = {"type": "hello", "protocol": 1, "capacity": 3, "proof": proof.hexdigest()}
            hostile.sendall(_frame(json.dumps(greeting).encode()))
        hostile.settimeout(0.02 if insider else 0.002)
        for data in _messages(random_):
            hostile.sendall(data)
            if random_.random() < 0.3:
                with contextlib.suppress(TimeoutError):
                    hostile.recv(4096)
        if insider or random_.random() < 0.7:
            hostile.close()


@contextlib.contextmanager
def fire() -> Iterator[Fire]:
    """Open a server and its honest clients, for cases of `Fire.case`."""
    with remote(token=TOKEN, signals=("x",), dt=0.1, length=3, timeout=20.0, retries=5) as system:
        attacked = Fire(system)
        yield attacked
        for hostile in attacked._open:
            hostile.close()


def _memory() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def _frame(text: bytes) -> bytes:
    return struct.pack(">I", len(text)) + text


def _received(hostile: socket.socket) -> bytes:
    data = b""
    while len(data) < 4 or len(data) < 4 + struct.unpack_from(">I", data)[0]:
        more = hostile.recv(4096)
        if not more:
            raise OSError("closed")
        data += more
    return data[4:]


def _messages(random_: random.Random) -> Iterator[bytes]:
    for _ in range(random_.randrange(1, 5)):
        data = _message(random_)
        if random_.random() < 0.3:
            index = random_.randrange(len(data) + 1)
            junk = random_.randbytes(random_.randrange(1, 9))
            data = random_.choice((data[:index], data[:index] + junk + data[index:]))
        yield data


def _message(random_: random.Random) -> bytes:
    match random_.randrange(9):
        case 0:
            return random_.randbytes(random_.randrange(1, 3000))
        case 1:  # Announced, and never sent.
            return struct.pack(">I", random_.choice((0, 4096, 1 << 24, (1 << 32) - 1))) + b"{"
        case 2:
            return _frame(b"[" * random_.choice((10, 4000, 100_000)))
        case 3:
            return _frame(random_.choice((b"null", b"{}", b"[]", b'"x"', b"1e999", b"\xff\xfe")))
        case 4:
            return b"GET / HTTP/1.1\r\nHost: here\r\n\r\n"
        case 5:
            alien = {"type": random_.choice(("hello", "bye", "work", "result", 7, None)),
                     "protocol": random_.choice((1, 2, "1", None, [1])),
                     "capacity": random_.choice((0, -1, 1, 10**9, "many", True, None, 1.5)),
                     "token": random_.choice(("", TOKEN[:-1], "é" * 900, None, 5)),
                     "name": random_.choice(("\x1b[2J", "a" * 3000, {"a": 1}, None))}  # fmt: skip
            return _frame(json.dumps(alien).encode())
    return _result(random_)


def _result(random_: random.Random) -> bytes:
    raw = random_.randbytes(random_.choice((0, 8, 24, 4000)))
    signal = random_.choice(
        (None, 1, "x", {}, [], [1, 2], [[1, 2, 3]], [1, "two", 3], [1e999, 0, 0], [None] * 4,
         {"$array": "<f8", "shape": [3], "at": random_.choice((0, -8, 10**12, "0", 1.5))},
         {"$array": "<f8", "shape": random_.choice(([10**9, 10**9], [-1], [[3]], "3")), "at": 0},
         {"$array": random_.choice(("O", "<M8[s]", "|S9", ">f8", 5)), "shape": [3], "at": 0})
    )  # fmt: skip
    header = {
        "type": "result",
        "id": random_.choice((0, 1, -1, 10**30, "1", None, [1], random_.randrange(5000))),
        "dt": random_.choice((0.1, 0, -1, "0.1", None, 1e999, 5e-324)),
        "signals": random_.choice(({"x": signal}, {"y": signal}, signal)),
        "valid": random_.choice((None, 0, -3, 99, "3", 2.5)),
        "bytes": random_.choice((len(raw), len(raw), -1, 10**12, "8", None)),
    }
    if random_.random() < 0.2:
        header["error"] = random_.choice(("\x1b]0;x\x07", "e" * 200_000, 5, {"a": []}))
    text = json.dumps(header).encode()
    return _frame(text) + raw
