import contextlib
import gc
import hashlib
import hmac
import json
import os
import re
import select
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import verifai_jax as vj
from verifai_jax.addons.simulators import remote_client
from verifai_jax.addons.simulators.remote import connection, server, wire
from verifai_jax.addons.simulators.remote._remote import remote
from verifai_jax.core.values.trace import Status
from verifai_jax.core.values.waveform import Waveform
from verifai_jax.systems.blackbox.trace_form import TraceForm

ROOT = Path(__file__).parents[4]
TOKEN = "a secret of the test"


PEERS = []


@pytest.fixture(autouse=True)
def _peers_end_with_their_test():
    yield
    while PEERS:
        PEERS.pop().close()


class Peer:
    """A client by hand: what it sends is up to the test."""

    def __init__(self, address, greet=True, **hello):
        self.socket = socket.create_connection(address, timeout=10)
        PEERS.append(self)
        self.hello = self.get()
        if greet:
            self.put({"type": "hello", "protocol": 1, **hello})

    def put(self, message, raw=b""):
        text = message if isinstance(message, bytes) else json.dumps(message).encode()
        self.socket.sendall(struct.pack(">I", len(text)) + text + raw)

    def get(self):
        (length,) = struct.unpack(">I", self.exactly(4))
        return json.loads(self.exactly(length))

    def exactly(self, n):
        data = b""
        while len(data) < n:
            more = self.socket.recv(n - len(data))
            if not more:
                raise EOFError
            data += more
        return data

    def points(self, n):
        found = []
        while len(found) < n:
            message = self.get()
            assert message["type"] == "work", message
            found += message["points"]
        return found

    def answer(self, point, x=1.0):
        self.put({"type": "result", "id": point["id"], "dt": 0.1, "signals": {"x": [x, x, x]}})

    def refusal(self):
        """The fatal error that comes, after which the connection must end."""
        message = self.get()
        assert message["type"] == "error"
        assert message["fatal"]
        with pytest.raises((EOFError, ConnectionResetError)):
            self.get()
        return message["message"]

    def close(self):
        self.socket.close()


@contextlib.contextmanager
def answering(system, simulate=None, **options):
    """A good client, in a thread of this process."""
    host, port = system.address

    def run():
        remote_client.serve(simulate or constant, host, port, reconnect=False, **options)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    yield thread


def constant(features, seed):
    return {"x": np.full(3, float(features["a"])), "dt": 0.1}


class Asked:
    """A call of `simulate_each` that goes on in a thread."""

    def __init__(self, system, n, seeds=None, features=None):
        self.features = features or [{"a": float(i)} for i in range(n)]
        self.seeds = seeds or [0] * n
        self.outcomes = []
        self.thread = threading.Thread(target=self.run, args=(system,), daemon=True)
        self.thread.start()

    def run(self, system):
        for index, outcome in system.simulate_each(self.features, self.seeds):
            self.outcomes.append((index, outcome))

    def all(self):
        self.thread.join(timeout=30)
        assert not self.thread.is_alive(), "the run did not end"
        indices = sorted(index for index, _ in self.outcomes)
        assert indices == list(range(len(self.features))), "each exactly once"
        return [outcome for _, outcome in sorted(self.outcomes, key=lambda pair: pair[0])]


@pytest.fixture
def system():
    with remote(signals=("x",), dt=0.1, length=3, timeout=20.0) as system:
        yield system


def until(condition, seconds=20):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.01)


# The wire


def decoded(data, most=1 << 20, pieces=None):
    frames, found = wire.Frames(most), []
    for at in range(0, len(data), pieces or len(data)):
        found += frames.feed(data[at : at + (pieces or len(data))])
    return found


@pytest.mark.parametrize("pieces", [None, 1, 7])
def test_what_the_client_encodes_is_the_trace(pieces):
    x, v = np.linspace(0, 1, 5), np.arange(10, dtype=np.float32).reshape(5, 2)
    n, b = np.arange(5), np.array([True, False, True, True, False])
    result = {"x": x, "v": v, "n": n, "b": b, "h": x.astype(np.float16), "dt": 0.5, "valid": 4}
    data = remote_client.encoded(7, result) + remote_client.encoded(
        8, {"signals": {"dt": x}, "times": x}
    )
    one, other = decoded(data, pieces=pieces)
    assert one.header["id"] == 7
    trace = wire.trace_of(one)
    assert (trace.dt, trace.valid, trace.times) == (0.5, 4, None)
    for name, array in (("x", x), ("v", v), ("n", n), ("b", b)):
        np.testing.assert_array_equal(trace[name], array)
        assert trace[name].dtype == array.dtype
    assert trace["h"].dtype == np.float64
    trace = wire.trace_of(other)
    assert list(trace.signals) == ["dt"]
    np.testing.assert_array_equal(trace.times, x)


def test_what_text_encodes_is_the_trace():
    text = b'{"type":"result","id":1,"signals":{"x":[1,2.5,null],"v":[[1,2],[3,4],[5,6]]},"dt":1}'
    (message,) = decoded(struct.pack(">I", len(text)) + text)
    trace = wire.trace_of(message)
    np.testing.assert_array_equal(trace["x"], [1, 2.5, np.nan])
    np.testing.assert_array_equal(trace["v"], [[1, 2], [3, 4], [5, 6]])


def test_the_frame_in_the_manual():
    text = (ROOT / "docs" / "remote.md").read_text()
    length, header, raw = re.search(r"\n((?:\w\w ){4})({.*})\n([\w\w ]+)\n", text).groups()
    data = bytes.fromhex(length) + header.encode() + bytes.fromhex(raw)
    (message,) = decoded(data)
    np.testing.assert_array_equal(wire.trace_of(message)["x"], [0.0, 1.0])
    for block in re.findall(r"```json\n(.*?)```", text, re.DOTALL):
        decoder, at = json.JSONDecoder(), 0
        while block[at:].strip():
            at += len(block[at:]) - len(block[at:].lstrip())
            example, at = decoder.raw_decode(block, at)
            assert example["type"] in ("hello", "work", "result")


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", "a frame of 1195725856 bytes was announced, at most 1048576"),
        (b"\0\0\0\4oops", "a frame must be UTF-8 JSON: .*; got b'oops'"),
        (b"\0\0\0\2\xff\xfe", "a frame must be UTF-8 JSON"),
        (b"\0\0\0\0", "a frame must be UTF-8 JSON"),
        (b"\0\0\0\2[]", r"a message must be an object with a type; got \[\]"),
        (b'\0\0\0\x0a{"type":1}', "a message must be an object with a type; got {'type': 1}"),
        (b"\0\1\0\0" + b"[" * 65536, "a frame must be UTF-8 JSON"),
        (wire.frame({"type": "result", "bytes": -1}), "'bytes' must be a number of bytes; got -1"),
        (wire.frame({"type": "result", "bytes": 1 << 20}), "frame of 10486.. bytes was announced"),
    ],
)
def test_what_is_no_frame(data, match):
    with pytest.raises(wire.WireError, match=match):
        decoded(data)


GOOD = {"type": "result", "id": 1, "dt": 0.1, "signals": {"x": [1.0, 2.0]}}
RAW = {"$array": "<f8", "shape": [2], "at": 0}


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"signals": {}}, "a result must have signals, an object of arrays by name; got {}"),
        ({"signals": {"x": 3}}, "signal 'x' must be an array; got 3"),
        ({"signals": {"x": ["a"]}}, r"signal 'x' must be an array of numbers; got \['a'\]"),
        (
            {"signals": {"x": [[1], [1, 2]]}},
            "signal 'x' must be an array of numbers in rows",
        ),
        ({"signals": {"x": []}}, "needs at least one sample"),
        ({"signals": {"x": [[[1]]]}}, r"must have shape \[time\] or \[time, k\]"),
        ({"signals": {"x": [1], "y": [1, 2]}}, "signals must have one length; got x: 1, y: 2"),
        ({"signals": {"x": {**RAW, "$array": "O"}}}, r"have a \$array of <f8.*; got 'O'"),
        ({"signals": {"x": {**RAW, "shape": [-1]}}}, "the shape of signal 'x' must be a list of"),
        (
            {"signals": {"x": {**RAW, "at": 1}}},
            "signal 'x' needs 16 bytes from 1; 16 were received",
        ),
        ({"signals": {"x": {**RAW, "shape": [10**30]}}}, "needs 8000000000000000000000000000000"),
        ({"signals": {"x": {**RAW, "shape": [10**4000] * 2}}}, "needs a huge number bytes from 0"),
        ({"dt": None}, "either a sampling period dt or sample times"),
        ({"dt": 0}, "dt must be a positive number of seconds; got 0"),
        ({"dt": "0.1"}, "dt must be a positive number of seconds; got '0.1'"),
        ({"dt": None, "times": [0, 0]}, "times must be numbers that increase strictly"),
        ({"valid": 3}, "valid must be how many samples count, from 1 to 2; got 3"),
        ({"signal": 3}, "unknown field of a result 'signal'; did you mean 'signals'"),
    ],
)
def test_what_is_no_result(change, match):
    (message,) = decoded(wire.frame({**GOOD, **change}))
    with pytest.raises(ValueError, match=match):
        wire.trace_of(message._replace(raw=bytes(16)))


@pytest.mark.parametrize("alien", ["NaN", "Infinity", "-Infinity"])
def test_json_has_no_nan(alien):
    text = json.dumps(GOOD).replace("2.0", alien).encode()
    (message,) = decoded(wire.frame(text))
    with pytest.raises(wire.WireError, match=f"JSON has no {alien}: send null .* or raw arrays"):
        wire.trace_of(message)


WHOLE = (
    remote_client.encoded(1, {"x": np.ones(3), "dt": 0.1}),
    wire.frame({**GOOD, "valid": 2}),
    wire.frame({**GOOD, "dt": None, "times": [0, 1]}),
)


@given(
    st.sampled_from(WHOLE),
    st.lists(st.tuples(st.floats(0, 1), st.binary(max_size=3)), min_size=1, max_size=5),
)
@settings(max_examples=300, deadline=None)
def test_whatever_comes_is_a_trace_or_a_clear_error(data, changes):
    for place, new in changes:
        at = int(place * len(data))
        data = data[:at] + new + data[at + 1 :]
    told = "a clear error"
    try:
        for message in decoded(data, most=1 << 16) if data else ():
            trace = TraceForm(("x",), 0.1).accept(wire.trace_of(message))
            assert list(trace.signals) == ["x"]
            assert 1 <= len(trace.signals["x"]) == trace.length
    except (ValueError, TypeError) as error:  # WireError is a ValueError
        told = str(error)
    assert told.isprintable()
    assert 10 < len(told) < 1000


def test_what_a_stranger_says_cannot_garble_a_log(system, caplog):
    peer = Peer(system.address, name="\x1b[31mred\r\n")
    asked = Asked(system, 2)
    peer.put({**GOOD, "id": peer.points(1)[0]["id"], "signals": {"\x1b[2J\n": [1]}})
    peer.get()
    peer.put({"type": "result", "id": peer.points(1)[0]["id"], "error": "\x1b[2J" + "a" * 9000})
    for outcome in asked.all():
        assert outcome.message.isprintable()
        assert len(outcome.message) <= 2000
    assert "[31mred" in caplog.text
    assert "\x1b" not in caplog.text


def test_features_arrive_as_they_are():
    wave = Waveform(np.array([0.5, -1.0, 2.0], np.float32), "linear", 4.0)
    steps = Waveform(np.arange(4.0), "constant", 2.0)
    features = {
        "a": 0.1,
        "n": 3,
        "s": "red",
        "cars": {"x": np.arange(6.0).reshape(2, 3), "k": np.float32(0.1)},
        "wave": wave,
        "steps": steps,
        "open": Waveform(np.ones((2, 2)), "linear"),
        "push": vj.Reactive({"gap": (0, 60), "v": (-1, 3)}, 2, (-3, 5)).coerce(
            list(np.linspace(-2, 2, 9))
        ),
        "pulses": Waveform(np.array([1.0, 2.0]), "pulse", 4.0, (0.5, 2.0), 1.5),
    }
    got = remote_client.features_of(json.loads(wire.to_text(wire.plain(features))))
    assert (got["a"], got["n"], got["s"]) == (0.1, 3, "red")
    np.testing.assert_array_equal(got["cars"]["x"], features["cars"]["x"])
    assert got["cars"]["k"] == float(np.float32(0.1))
    for time_ in (-1.0, 0.0, 0.3, 1.0, 2.0, 3.9, 4.0, 9.0):
        np.testing.assert_allclose(got["wave"](time_), wave(time_), rtol=1e-6)
        np.testing.assert_allclose(got["steps"](time_), steps(time_), rtol=1e-6)
        assert got["pulses"](time_) == features["pulses"](time_)
    assert abs(got["push"](20.0, v=1.5) - features["push"](20.0, v=1.5)) < 1e-5
    with pytest.raises(ValueError, match="this reaction takes gap, v, each once"):
        got["push"](gap=1.0)
    np.testing.assert_array_equal(got["open"].over(2.0)(1.0), [1.0, 1.0])
    with pytest.raises(ValueError, match="has no duration"):
        got["open"](1.0)
    with pytest.raises(TypeError, match="a feature of type object cannot be sent"):
        wire.to_text(wire.plain({"a": object()}))


# A run and its clients


def test_each_simulation_once_with_its_seed(system):
    def simulate(features, seed):
        return {"x": np.array([features["a"], seed, 0.0]), "dt": 0.1}

    with answering(system, simulate), answering(system, simulate):
        outcomes = Asked(system, 300, [2**32 - 1 - i for i in range(300)]).all()
        again = Asked(system, 5).all()
    assert [list(o.trace["x"]) for o in outcomes] == [[i, 2**32 - 1 - i, 0] for i in range(300)]
    assert [o.trace["x"][0] for o in again] == [0, 1, 2, 3, 4]
    with answering(system, simulate):
        trace = system({"a": np.float32(0.5)}, jax.random.key(0))
    assert list(trace["x"]) == [0.5, int(jax.random.bits(jax.random.key(0))), 0.0]


def test_what_a_simulator_raises_is_a_row(system):
    def simulate(features, seed):
        return {"x": [1 / features["a"]] * 3, "dt": 0.1} if features["a"] != 1 else 17

    with answering(system, simulate):
        outcomes = Asked(system, 3).all()
        assert [o.status.name for o in outcomes] == ["ERROR", "ERROR", "OK"]
        assert outcomes[0].message.startswith("ZeroDivisionError: float division by zero (")
        assert re.search(r"test_remote.py, line \d+, in simulate\)$", outcomes[0].message)
        assert outcomes[1].message == (
            "TypeError: simulate must return a dictionary of signals and dt, such as "
            "{'x': x, 'dt': 0.02}; it returned int"
        )
        with pytest.raises(RuntimeError, match="ZeroDivisionError"):
            system({"a": 0.0})


def test_a_client_never_has_more_than_its_capacity(system):
    peer = Peer(system.address, capacity=4)
    asked = Asked(system, 40)
    held, most = peer.points(1), 0
    for _ in range(40):
        peer.answer(held.pop(0))
        most = max(most, len(held))
        while not held and len(asked.outcomes) < 40:
            peer.socket.settimeout(0.2)
            with contextlib.suppress(TimeoutError):
                held += peer.points(1)
        peer.socket.settimeout(0.02)
        with contextlib.suppress(TimeoutError):
            while True:
                held += peer.points(1)
        assert len(held) <= 4
        most = max(most, len(held))
        if len(asked.outcomes) == 40:
            break
    # How soon it is trusted with all four depends on how soon it answers.
    assert most >= 2
    assert all(o.status == Status.OK for o in asked.all())


def test_a_slow_client_is_given_no_more_than_it_works_on(system, monkeypatch):
    monkeypatch.setattr(connection, "SWIFT", 0.0)
    peer = Peer(system.address, capacity=32)
    asked = Asked(system, 3)
    for _ in range(3):
        (point,) = peer.points(1)
        # Nothing else comes before the answer.
        assert not select.select([peer.socket], [], [], 0.05)[0]
        peer.answer(point)
    asked.all()


def test_wrong_traces_are_told_to_the_client_and_rows(system, caplog):
    peer = Peer(system.address, capacity=6, parallel=6)
    asked = Asked(system, 6)
    points = peer.points(6)
    good = {"type": "result", "dt": 0.1, "signals": {"x": [1.0, 1.0, 1.0]}}
    changes = [
        {"signals": {"y": [1, 1, 1]}},
        {"signals": {"x": [1, 1]}},
        {"dt": 0.2},
        {"signals": {"x": [[1, 1], [1, 1], [1, 1]]}},
        {"signals": {"x": [1.0, float("nan"), 1.0]}},
        {},
    ]
    expected = [
        "the trace must have the signals x; got y (x missing; y not expected)",
        "the trace must have 3 samples; got 2",
        "the trace must have the sampling period dt=0.1; got dt=0.2",
        "signal 'x' must be [time]; got [3, 2]; declare vectors by signals={'x': 2, ...}",
        "JSON has no NaN: send null for what is not a number, or raw arrays",
    ]
    for point, change in zip(points, changes, strict=True):
        peer.put({**good, "id": point["id"], **change})
    told = [peer.get() for _ in expected]
    assert [message["message"] for message in told] == expected
    assert [message["id"] for message in told] == [point["id"] for point in points[:5]]
    assert not any(message["fatal"] for message in told)
    outcomes = asked.all()
    assert [o.message for o in outcomes] == [*expected, ""]
    assert [o.status.name for o in outcomes] == ["ERROR"] * 5 + ["OK"]
    for message in expected:
        assert message in caplog.text


def test_unknown_points_are_told_and_answers_twice_ignored(system):
    peer = Peer(system.address)
    asked = Asked(system, 2)
    (point,) = peer.points(1)
    peer.put({**GOOD, "id": 999})
    assert peer.get()["message"] == "no point 999 was handed to this client"
    peer.put({**GOOD, "id": "one"})
    assert peer.get()["message"] == "no point 'one' was handed to this client"
    peer.answer(point, 1.0)
    peer.answer(point, 2.0)
    (other,) = peer.points(1)
    peer.answer(other, 3.0)
    assert [o.trace["x"][0] for o in asked.all()] == [1.0, 3.0]


def test_points_of_a_client_that_vanishes_go_to_others(system):
    gone = Peer(system.address, capacity=8, parallel=8)
    asked = Asked(system, 20)
    assert len(gone.points(8)) == 8
    gone.close()
    with answering(system):
        assert all(o.status == Status.OK for o in asked.all())


def test_a_point_that_takes_its_clients_along_is_a_row(system):
    asked = Asked(system, 1)
    for _ in range(2):
        peer = Peer(system.address, name="a\nb")
        (point,) = peer.points(1)
        where = "{}:{}".format(*peer.socket.getsockname()[:2])
        peer.close()
    (outcome,) = asked.all()
    assert outcome.status == Status.ERROR
    assert outcome.message == (
        f"the simulator a b ({where}) closed the connection while it simulated this "
        "(attempt 2 of 2)"
    )
    assert point["features"] == {"a": 0.0}


def test_a_lost_point_goes_to_a_client_that_has_answered_before(system):
    good = Peer(system.address)
    bad = Peer(system.address)
    until(lambda: len(system.clients) == 2)
    asked = Asked(system, 4)
    good.answer(good.points(1)[0])
    bad.points(1)
    bad.close()
    # One that dies of everything comes back at once, and is given a new point, not the lost one.
    bad = Peer(system.address)
    third = bad.points(1)
    fourth = good.points(1)
    good.answer(fourth[0])
    assert third[0]["features"] != {"a": 1.0}
    lost = good.points(1)
    good.answer(lost[0])
    bad.answer(third[0])
    assert all(o.status == Status.OK for o in asked.all())


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (os.urandom(64).replace(b"\0", b"\1"), "frame of .* bytes was announced, at most 16777216"),
        (struct.pack(">I", 50 << 20), "a frame of 52428800 bytes was announced"),
        (struct.pack(">I", 5) + b"12345", "must be an object with a type; got 12345"),
        (wire.frame({"type": "reslut"}), "unknown type of message 'reslut'; did you mean 'result'"),
    ],
    ids=["random", "oversized", "number", "type"],
)
def test_garbage_is_told_and_stops_no_other(system, caplog, data, match):
    bad = Peer(system.address, name="bad")
    asked = Asked(system, 5)
    bad.points(1)
    bad.socket.sendall(data)
    with answering(system):
        assert all(o.status == Status.OK for o in asked.all())
    assert re.search(match, bad.refusal())
    assert "simulator bad (127.0.0.1" in caplog.text


@pytest.mark.parametrize(
    ("hello", "match"),
    [
        ({"type": "result", "id": 1}, "the first message of a client must be its hello"),
        ({"type": "hello", "protocol": 2}, "this server speaks protocol 1; got 2"),
        ({"type": "hello", "protocol": 1, "capacity": 0}, "capacity must be an integer from 1 to"),
        (
            {"type": "hello", "protocol": 1, "parallel": 2},
            "parallel must be an integer from 1",
        ),
        ({"type": "hello", "protocol": 1, "name": "a" * 5000}, "at most 4096 are accepted"),
    ],
)
def test_bad_greetings(system, hello, match):
    peer = Peer(system.address, greet=False)
    peer.put(hello)
    assert match in peer.refusal()
    assert system.clients == []


def test_one_that_does_not_greet_is_sent_away(system, monkeypatch):
    monkeypatch.setattr(connection, "GREETING_SECONDS", 0.2)
    peer = Peer(system.address, greet=False)
    peer.socket.sendall(b"\0\0")
    assert peer.refusal() == "no hello came within 0.2 s"


def test_the_hello_says_what_is_expected(system):
    hello = Peer(system.address, greet=False).hello
    assert hello == {
        "type": "hello",
        "protocol": 1,
        "challenge": None,
        "max_bytes": 16777216,
        "signals": {"x": 1},
        "dt": 0.1,
        "length": 3,
    }


def test_only_who_knows_the_token_is_let_in(caplog):
    with remote(token=TOKEN) as system:
        for hello in ({"token": TOKEN[:-1]}, {"token": None}, {"proof": "0" * 64}, {"proof": 3}):
            assert Peer(system.address, **hello).refusal() == "the token is wrong"
        assert "this server needs a token" in Peer(system.address).refusal()
        assert Peer(system.address, token=TOKEN).hello["challenge"] is not None
        proved = Peer(system.address, greet=False)
        challenge = proved.hello["challenge"].encode()
        proof = hmac.new(TOKEN.encode(), challenge, hashlib.sha256).hexdigest()
        proved.put({"type": "hello", "protocol": 1, "proof": proof})
        until(lambda: len(system.clients) == 2)
        with pytest.raises(remote_client.Refused, match="the server refuses: the token is wrong"):
            remote_client.serve(constant, *system.address, token="guess")
        with pytest.raises(remote_client.Refused, match="asks for a token; give token="):
            remote_client.serve(constant, *system.address)
        # A proof is good for one connection only.
        assert Peer(system.address, proof=proof).refusal() == "the token is wrong"
        assert TOKEN not in caplog.text
        assert TOKEN not in repr(system)


def test_a_simulation_that_takes_too_long():
    with remote(timeout=1.5) as system:
        stuck = Peer(system.address, capacity=4, parallel=2)
        asked = Asked(system, 6)
        points = stuck.points(2)
        with answering(system):
            outcomes = asked.all()
        assert [o.status.name for o in outcomes] == ["TIMEOUT"] * 2 + ["OK"] * 4
        assert outcomes[0].message.startswith("the simulation took longer than 1.5 s at 127.0.0.1:")
        first, second = (point["id"] for point in points)
        assert stuck.refusal() == f"point {first}, {second} took longer than 1.5 s"


@pytest.mark.slow
def test_time_is_counted_from_when_a_client_can_begin():
    with remote(timeout=2.0) as system:
        peer = Peer(system.address, capacity=8)
        asked = Asked(system, 9)
        peer.answer(peer.points(1)[0])
        held = peer.points(2)
        peer.answer(held.pop(0))
        held += peer.points(2)
        for _ in range(4):
            time.sleep(0.75)
            peer.answer(held.pop(0))
            peer.socket.settimeout(0.1)
            with contextlib.suppress(TimeoutError):
                held += peer.points(1)
        with answering(system):
            peer.close()
            assert all(o.status == Status.OK for o in asked.all())


def test_nobody_there(caplog, monkeypatch):
    monkeypatch.setattr(connection, "REMINDER", 0.2)
    with remote(patience=0.7) as system:
        outcomes = Asked(system, 3).all()
        host, port = system.address
    assert {o.message for o in outcomes} == {"no simulator was connected for 0.7 s"}
    assert (
        f"no simulator has connected to ('{host}', {port}) for 0 s; start one with "
        "`python -m verifai_jax.addons.simulators.remote_client "
        f"--address {host}:{port} MODULE:FUNCTION`"
    ) in caplog.text


def test_the_port_is_free_again_at_once_and_clients_come_back():
    with remote() as system:
        port = system.address[1]
        host, _ = system.address
        options = {"reconnect": 20.0}
        thread = threading.Thread(
            target=remote_client.serve, args=(constant, host, port), kwargs=options, daemon=True
        )
        thread.start()
        Asked(system, 5).all()
        with (
            pytest.raises(
                OSError, match=f"cannot connect at '127.0.0.1', port {port}: .* another run"
            ),
            remote(port=port),
        ):
            pass
    for _ in range(3):
        with remote(port=port) as system:
            assert all(o.status == Status.OK for o in Asked(system, 5).all())
        assert "127.0.0.1" in repr(system)


def test_a_closed_server_ends_the_run_with_an_error():
    system = remote()
    waiting = system.simulate_each([{"a": 1.0}], [0])
    failure = []

    def wait():
        try:
            next(waiting)
        except ConnectionError as error:
            failure.append(str(error))

    thread = threading.Thread(target=wait)
    thread.start()
    until(lambda: system._server is not None and system._server.batches)
    system.close()
    thread.join(timeout=5)
    assert failure == ["the server for remote simulators was closed"]


def test_one_that_is_forgotten_closes_its_port():
    system = remote()
    address = system.address
    peer = Peer(address)
    until(lambda: len(system.clients) == 1)
    del system
    gc.collect()
    assert peer.get() == {"type": "bye"}
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(address, timeout=5)


def test_points_of_a_caller_that_stops_are_dropped(system):
    waiting = system.simulate_each([{"a": float(i)} for i in range(50)], [0] * 50)
    with answering(system):
        next(waiting)
        waiting.close()
        assert [o.trace["x"][0] for o in Asked(system, 2).all()] == [0.0, 1.0]


@pytest.mark.skipif(not socket.has_ipv6, reason="no IPv6")
def test_both_protocols():
    try:
        with socket.socket(socket.AF_INET6) as sock:
            sock.bind(("::1", 0))
    except OSError:
        pytest.skip("this machine has no ::1")
    with remote(host="localhost") as system:
        (four, port), (six, same) = system.addresses
        assert (four, six, port) == ("127.0.0.1", "::1", same)
        one, other = Peer((four, port)), Peer((six, port))
        until(lambda: len(system.clients) == 2)
        one.close()
        other.close()
    with remote(host="::1") as system, answering(system):
        assert system.address[0] == "::1"
        assert Asked(system, 1).all()[0].status == Status.OK


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"host": "0.0.0.0"}, "host '0.0.0.0' is open to other machines, .*: give token="),
        ({"host": "::"}, "host '::' is open to other machines"),
        ({"host": ""}, "host must be a name or an address, such as '127.0.0.1'; got ''"),
        ({"port": 70000}, "port must be an integer from 0 to 65535; got 70000"),
        ({"token": " "}, "token must be a text that is hard to guess; got an empty one"),
        ({"timeout": 0}, "timeout must be a positive number of seconds; got 0"),
        ({"patience": -1}, "patience must be a positive number of seconds; got -1"),
        ({"retries": -1}, "retries must be an integer of at least 0; got -1"),
        ({"max_bytes": 10}, r"max_bytes must be an integer from 1024 to 2\*\*31 - 1; got 10"),
        ({"tokn": "x"}, "unknown option of remote 'tokn'; did you mean 'token'"),
    ],
)
def test_refuses_bad_options(options, match):
    with pytest.raises(ValueError, match=match):
        remote(**options)


def test_a_problem_is_checked_against_what_is_declared():
    system = remote(signals=("x",), dt=0.1, length=5)
    with pytest.raises(ValueError, match="y"):
        vj.Problem("p", {"a": vj.Box(0, 1)}, system, "always y <= 1").check()
    assert system._server is None, "nothing listens before it is needed"


# Whole processes

SIMULATOR = """
import time
import numpy as np

def simulate(features, seed):
    time.sleep(0.002)
    return {"x": np.array([features["a"], features["b"], seed % 1000]), "dt": 1.0}
"""


def process(tmp_path, port, *options):
    file = tmp_path / "simulator.py"
    file.write_text(SIMULATOR)
    command = [sys.executable, remote_client.__file__, "--address", f"127.0.0.1:{port}"]
    return subprocess.Popen([*command, *options, f"{file}:simulate"], stderr=subprocess.DEVNULL)


@pytest.mark.slow
def test_four_clients_one_killed_one_that_sends_garbage(tmp_path):
    space = {"a": vj.Box(-1.0, 1.0), "b": vj.Box(-1.0, 1.0)}
    done = threading.Event()

    def send_garbage(address):
        while not done.is_set():
            # As fast as it can, so that it would soon have had every point twice.
            with contextlib.suppress(OSError, EOFError, AssertionError):
                bad = Peer(address, name="garbage")
                bad.socket.settimeout(2.0)
                bad.points(1)
                bad.socket.sendall(b"\xffgarbage")
                bad.refusal()
            bad.close()

    with remote(signals=("x",), dt=1.0, length=3) as system:
        clients = [process(tmp_path, system.address[1]) for _ in range(3)]
        bad = threading.Thread(target=send_garbage, args=(system.address,), daemon=True)
        try:
            until(lambda: len(system.clients) == 3)
            bad.start()
            killer = threading.Timer(0.3, clients[0].send_signal, [signal.SIGKILL])
            killer.start()
            problem = vj.Problem("both", space, system, "always x <= 1000")
            run = vj.falsify(problem, "uniform", budget=600, batch=200, progress=False)
            assert clients[0].wait(timeout=5) == -signal.SIGKILL
        finally:
            done.set()
            bad.join(timeout=5)
            for client in clients:
                client.kill()
                client.wait()
    table = run.table.all
    assert len(table) == 600
    assert (table["status"] == "ok").all()
    # Each row is its own simulation: the same table as by a function of this process.
    local = vj.Problem(
        "both",
        space,
        vj.blackbox(
            lambda f, seed: vj.Trace({"x": np.array([f["a"], f["b"], seed % 1000])}, dt=1.0),
            seeded=True,
        ),
        "always x <= 1000",
    )
    same = vj.falsify(local, "uniform", budget=600, batch=200, progress=False).table.all
    for column in ("a", "b", "rho"):
        np.testing.assert_array_equal(table[column], same[column])


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """The client in C, with the compiler's checks of memory where there are some."""
    if shutil.which("gcc") is None:
        pytest.skip("no gcc")
    program = tmp_path_factory.mktemp("c") / "pendulum"
    source = ROOT / "examples" / "remote" / "pendulum.c"
    options = ["-O1", "-Wall", "-Wextra", "-Werror", "-o", program, source, "-lm"]
    checks = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    if subprocess.run(["gcc", *checks, *options], capture_output=True, timeout=60).returncode:
        subprocess.run(["gcc", *options], check=True, timeout=60)
    return program


def test_the_client_in_c(program):
    source = ROOT / "examples" / "remote" / "pendulum.c"
    sys.path.insert(0, str(source.parent))
    try:
        from pendulum import simulate
    finally:
        sys.path.pop(0)
    expected = {"signals": ("theta", "omega"), "dt": 0.02, "length": 200}
    with remote(token=TOKEN, **expected) as system:
        client = subprocess.Popen([program, "127.0.0.1", str(system.address[1]), TOKEN])
        features = [{"theta0": 0.1 * i, "length": 1.0} for i in range(10)] + [{"theta0": 1.0}]
        outcomes = Asked(system, 11, features=features).all()
    assert client.wait(timeout=10) == 0
    for each, outcome in zip(features[:10], outcomes, strict=False):
        trace = simulate(each, 0)
        np.testing.assert_allclose(outcome.trace["theta"], trace["theta"], rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(outcome.trace["omega"], trace["omega"], rtol=1e-6, atol=1e-9)
    assert outcomes[10].message == "the pendulum needs theta0 and length"


def test_the_client_needs_neither_jax_nor_this_package():
    code = (
        "import runpy, sys; runpy.run_path(sys.argv[1]); "
        "print([m for m in ('jax', 'pandas', 'verifai_jax') if m in sys.modules])"
    )
    command = [sys.executable, "-c", code, remote_client.__file__]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=30)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (["--address", "here", "json:dumps"], "an address is HOST:PORT"),
        (["json:dump_it"], "json has no function 'dump_it'"),
        (["nowhere.py:simulate"], "no file nowhere.py"),
        (["simulate"], "a simulator is MODULE:FUNCTION or FILE.py:FUNCTION; got 'simulate'"),
    ],
)
def test_the_client_says_what_is_wrong_with_its_command_line(arguments, match, capsys):
    before = list(sys.path)
    with pytest.raises(SystemExit):
        remote_client.main(arguments)
    sys.path[:] = before
    assert match in capsys.readouterr().err


def test_addresses():
    assert remote_client.address_of("[::1]:45") == ("::1", 45)
    assert remote_client.address_of("example.org:4567") == ("example.org", 4567)


def test_a_client_gives_up_where_there_is_no_run():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(ConnectionError, match=f"no run at 127.0.0.1:{port} to simulate for"):
        remote_client.serve(constant, port=port, reconnect=0.2)


# Attacks


def test_connections_that_say_nothing_shut_nobody_out(system, monkeypatch):
    monkeypatch.setattr(server, "MAX_CLIENTS", 4)
    silent = [socket.create_connection(system.address, timeout=10) for _ in range(20)]
    with answering(system):
        outcomes = Asked(system, 3).all()
    assert [outcome.message for outcome in outcomes] == [""] * 3
    assert len(system._open().clients) <= 5
    for each in silent:
        each.close()


def test_a_full_server_is_tried_again(system, monkeypatch, program):
    monkeypatch.setattr(server, "MAX_CLIENTS", 2)
    peers = [Peer(system.address) for _ in range(2)]
    until(lambda: len(system.clients) == 2)
    refused = Peer(system.address, greet=False)
    assert refused.hello == {
        "type": "error",
        "message": "there are 2 clients already",
        "id": None,
        "fatal": True,
        "retry": True,
    }
    with pytest.raises(ConnectionError, match="to simulate for: the server refuses: there are 2"):
        remote_client.serve(constant, *system.address, reconnect=0.1)
    client = subprocess.Popen(
        [program, "127.0.0.1", str(system.address[1])], stderr=subprocess.PIPE, text=True
    )
    assert "there are 2 clients already" in client.stderr.readline()
    peers[0].close()
    until(lambda: any("pendulum.c" in name for name in system.clients))
    system.close()
    assert client.wait(timeout=10) == 0
    client.stderr.close()


def test_the_memory_of_all_clients_is_bounded(caplog):
    options = {"max_bytes": 1 << 20, "max_memory": 2 << 20}
    with remote(signals=("x",), dt=0.1, length=3, retries=0, **options) as system:
        hogs = [Peer(system.address) for _ in range(6)]
        until(lambda: len(system.clients) == 6)
        asked = Asked(system, 6)
        for hog in hogs:
            hog.points(1)
            with contextlib.suppress(OSError):
                hog.socket.sendall(struct.pack(">I", 1 << 20) + b"x" * 900_000)
        until(lambda: len(system.clients) == 2)
        assert sum(client.held for client in list(system._open().clients)) <= 2 << 20
        message = hogs[0].get()
        assert message["retry"]
        assert "messages of all clients hold more than 2097152 bytes" in message["message"]
        # The honest one has all points that theirs had; the last two lose them when they end.
        with answering(system):
            until(lambda: len(asked.outcomes) == 4)
            for hog in hogs:
                hog.close()
            outcomes = asked.all()
    assert sorted(outcome.message for outcome in outcomes)[:4] == [""] * 4


def test_a_header_that_waits_for_its_raw_bytes_is_not_kept_parsed():
    frames = wire.Frames(1 << 20)
    header = b'{"type":"result","bytes":8,"a":[' + b"[]," * 10_000 + b"0]}"
    data = struct.pack(">I", len(header)) + header + bytes(8)
    assert list(frames.feed(data[:-1])) == []
    assert len(frames) == len(data) - 1
    (message,) = frames.feed(data[-1:])
    assert message.raw == bytes(8)
    assert len(frames) == 0


def framed(text):
    return struct.pack(">I", len(text)) + text


HELLO = framed(b'{"type":"hello","protocol":1,"challenge":null}')
HOSTILE = {
    "HTTP": (b"HTTP/1.1 400 Bad Request\r\n\r\n", "announces 1213486160 bytes"),
    "no JSON": (framed(b"what?"), "it sends no JSON"),
    "no UTF-8": (framed(b"\xff\xfe\xfd"), "it sends no JSON"),
    "a list": (framed(b"[1, 2]"), "it sends a list, no object"),
    "deep": (framed(b"[" * 60_000), "it sends no JSON"),
    "huge": (struct.pack(">I", 2**32 - 1) + b"x" * 100_000, "announces 4294967295 bytes"),
    "protocol": (framed(b'{"type":"hello","protocol":[[3]]}'), "the server a list"),
    "escape": (framed(rb'{"type":"error","message":"\u001b[2J\nno"}'), "refuses:  [2J no"),
    "long": (framed(b'{"type":"error","message":"' + b"a" * 60_000 + b'"}'), "aaa\\.\\.\\.$"),
    "no points": (HELLO + framed(b'{"type":"work"}'), "it sends work without points"),
    "texts": (HELLO + framed(b'{"type":"work","points":["a"]}'), "a point without features"),
    "no id": (
        HELLO + framed(b'{"type":"work","points":[{"features":{},"seed":1}]}'),
        "a point without an integer id and seed",
    ),
    "many": (
        HELLO
        + framed(
            b'{"type":"work","points":['
            + b",".join([b'{"id":1,"seed":1,"features":{}}'] * 40)
            + b"]}"
        ),
        "sends more than 32 points",
    ),
    "later": (HELLO + struct.pack(">I", 1 << 30), "announces 1073741824 bytes"),
}


@contextlib.contextmanager
def pretending(data):
    """A server that is none: it sends `data` to whoever connects, and closes."""
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def serve():
            with contextlib.suppress(OSError):
                while True:
                    peer, _ = listening.accept()
                    with peer, contextlib.suppress(OSError):
                        peer.settimeout(5)
                        peer.sendall(data)
                        peer.shutdown(socket.SHUT_WR)
                        while peer.recv(4096):
                            pass

        threading.Thread(target=serve, daemon=True).start()
        yield listening.getsockname()
        listening.shutdown(socket.SHUT_RDWR)


@pytest.mark.parametrize("name", HOSTILE)
def test_a_server_that_is_none_ends_the_client_with_a_line(name):
    data, match = HOSTILE[name]
    match = match if match.endswith("$") else re.escape(match)
    with pretending(data) as address, pytest.raises(remote_client.Refused, match=match) as refused:
        remote_client.serve(constant, *address, reconnect=5)
    assert "\n" not in str(refused.value)
    assert "\x1b" not in str(refused.value)
    assert len(str(refused.value)) < 400


def test_a_server_that_is_slow_to_say_hello_is_given_up(monkeypatch):
    monkeypatch.setattr(remote_client, "GREETING_SECONDS", 0.2)
    timed_out = pytest.raises(ConnectionError, match=r"no run at .*no hello \(timed out\)")
    with socket.create_server(("127.0.0.1", 0)) as listening, timed_out:
        remote_client.serve(constant, *listening.getsockname(), reconnect=False)


@pytest.mark.parametrize("name", ["HTTP", "no JSON", "deep", "huge", "no id", "later", "escape"])
def test_a_server_that_is_none_cannot_crash_the_client_in_c(program, name):
    data, _ = HOSTILE[name]
    with pretending(data) as (_, port):
        done = subprocess.run(
            [program, "127.0.0.1", str(port)], capture_output=True, text=True, timeout=10
        )
    assert done.returncode in (0, 1)
    assert len(done.stderr.splitlines()) <= 2
    assert "Sanitizer" not in done.stderr
    assert "\x1b" not in done.stderr
