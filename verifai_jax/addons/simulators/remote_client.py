"""A simulator that answers a run over the network; needs nothing but Python and NumPy.

    from verifai_jax.addons.simulators.remote_client import serve

    def simulate(features, seed):
        return {"x": x, "v": v, "dt": 0.02}

    serve(simulate, port=4567)

or `python -m verifai_jax.addons.simulators.remote_client mysimulator:simulate`.

This file imports nothing of `verifai_jax`, so it may be copied to where that is not installed, or
run by its path, which starts faster. `docs/remote.md` says what goes over the wire.
"""

import argparse
import hashlib
import hmac
import importlib
import importlib.util
import json
import logging
import os
import select
import socket
import ssl
import struct
import subprocess
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

log = logging.getLogger("verifai_jax.remote_client")
PROTOCOL = 1
"""Version of the protocol that `docs/remote.md` describes."""
FLUSH_SECONDS = 0.005
"""Time for which a result may wait for others, to be sent with them."""
FLUSH_BYTES = 1 << 18
"""Size from which waiting results are sent at once."""
SHORTEST_PAUSE, LONGEST_PAUSE = 0.05, 2.0
"""Seconds between two attempts to connect."""
GREETING_SECONDS = 10.0
"""Seconds within which a server must say hello."""
GREETING_BYTES, MAX_BYTES = 1 << 16, 16 << 20
"""Bytes of a server's hello, and of any later message, beyond which it is none."""
MAX_LOGGED = 20
"""Errors of one server that are logged."""
RESERVED = ("dt", "times", "valid")
"""Names in a result that are no signals."""


class Refused(ConnectionError):
    """An error from a server that refuses this client for good."""


class Full(ConnectionError):
    """An error from a server that has no room for this client now, but may have later."""


class Waveform:
    """A function of time given by control points: the form in which a `Signal` feature arrives.

    Call `wind(time)` with seconds, or `wind.over(4.0)(time)` if the feature has no duration. With
    `hold` `"linear"` and `"pchip"` (a monotone cubic) the first control point is the value at 0 and
    the last that at the end; with `"constant"` each is held for an equal part of the duration, with
    `"pulse"` for `width` seconds of it, and the value is 0 for the rest. `times` are those of the
    control points, unless they are at equal distances.
    """

    def __init__(
        self, knots: Sequence[float] | np.ndarray, hold: str, duration: float | None,
        times: Sequence[float] | None = None, width: float | None = None,
    ) -> None:  # fmt: skip
        self.knots, self.hold, self.duration = np.asarray(knots, np.float64), hold, duration
        self.times, self.width = times, width

    def over(self, duration: float) -> "Waveform":
        """Return the same control points with this duration in seconds."""
        return Waveform(self.knots, self.hold, float(duration), self.times, self.width)

    def __call__(self, time: float) -> Any:
        """Return the value at a time in seconds; the first and the last hold beyond the ends."""
        if self.duration is None and self.times is None:
            raise ValueError("this signal has no duration: call features[...].over(seconds)(time)")
        count, held = len(self.knots), self.hold in ("constant", "pulse")
        if self.times is not None:
            times = np.asarray(self.times, float)
        else:
            times = np.linspace(0, self.duration, count + held)[:count]  # pyright: ignore[reportArgumentType, reportCallIssue]
        gaps = np.diff(times)
        if held:
            shortest = gaps.min() if count > 1 else self.duration or 1.0
            later = time + 1e-5 * shortest
            piece = max(int(np.searchsorted(times, later, side="right")) - 1, 0)
            width = shortest / 2 if self.width is None else self.width
            on = self.hold == "constant" or 0 <= later - times[piece] < width
            return self.knots[piece] if on else 0 * self.knots[piece]
        if count == 1:
            return self.knots[0]
        left = min(max(int(np.searchsorted(times, time, side="right")) - 1, 0), count - 2)
        share = min(max((time - times[left]) / gaps[left], 0.0), 1.0)
        begin, end = self.knots[left], self.knots[left + 1]
        value = begin * (1 - share) + end * share
        if self.hold == "pchip" and count > 2:
            first, last = self._slope(gaps, left), self._slope(gaps, left + 1)
            value = begin * (1 + 2 * share) * (1 - share) ** 2 + end * share**2 * (3 - 2 * share)
            bent = first * (1 - share) - last * share
            value = value + gaps[left] * share * (1 - share) * bent
        return np.clip(value, np.minimum(begin, end), np.maximum(begin, end))

    def _slope(self, gaps: np.ndarray, i: int) -> Any:
        """Return the slope of the cubic at a control point, as MATLAB's and SciPy's `pchip`."""
        secants = np.diff(self.knots, axis=0) / gaps.reshape(-1, *[1] * (self.knots.ndim - 1))
        if 0 < i < len(gaps):
            (h0, h1), (d0, d1) = gaps[i - 1 : i + 1], secants[i - 1 : i + 1]
            same = d0 * d1 > 0
            below = np.where(same, (2 * h1 + h0) * d1 + (h1 + 2 * h0) * d0, 1)
            return np.where(same, 3 * (h0 + h1) * d0 * d1 / below, 0)
        j, k = (0, 1) if i == 0 else (-1, -2)
        h0, h1, d0, d1 = gaps[j], gaps[k], secants[j], secants[k]
        slope = ((2 * h0 + h1) * d0 - h0 * d1) / (h0 + h1)
        steep = (np.sign(d0) != np.sign(d1)) & (abs(slope) > 3 * abs(d0))
        slope = np.where(steep, 3 * d0, slope)
        return np.where(np.sign(slope) == np.sign(d0), slope, 0)


class Reaction:
    """A function of signals given by parameters: the form in which a `Reactive` feature arrives.

    Call it at each step with `push(gap=12.0, speed=3.0)`, or with the signals in the order of
    `inputs`; it returns a number within its bounds.
    """

    def __init__(
        self, parameters: Sequence[float], inputs: Any, hidden: int, bounds: Sequence[float]
    ) -> None:
        self.parameters, self.hidden = np.asarray(parameters, np.float64), hidden
        self.inputs, self.bounds = {name: (low, high) for name, low, high in inputs}, bounds

    def __call__(self, *values: float, **named: float) -> float:
        """Return the reaction to signals, in the order of `inputs` or by their names."""
        given = dict(zip(self.inputs, values, strict=False)) | named
        if given.keys() != self.inputs.keys() or len(values) + len(named) != len(given):
            raise ValueError(f"this reaction takes {', '.join(self.inputs)}, each once")
        ends = self.inputs.items()
        x = np.array([(2 * given[name] - low - high) / (high - low) for name, (low, high) in ends])
        if self.hidden:
            size = self.hidden * len(x)
            first = self.parameters[:size].reshape(self.hidden, len(x))
            x = np.tanh(first @ x + self.parameters[size:][: self.hidden])
        last, (low, high) = self.parameters[-(len(x) + 1) :], self.bounds
        return float(low + (high - low) * (1 + np.tanh(last[:-1] @ x + last[-1])) / 2)


def serve(
    simulate: Callable[[dict[str, Any], int], Any],
    host: str = "127.0.0.1",
    port: int = 4567,
    token: str | None = None,
    capacity: int = 32,
    reconnect: bool | float = True,
    name: str | None = None,
    certificate: str | os.PathLike[str] | None = None,
) -> None:
    """Simulate the points of the run at `host` and `port` until interrupted.

    **Arguments:**
    - `simulate(features, seed) -> result`: features are numbers, arrays, dictionaries of these,
      `Waveform`s and `Reaction`s; `seed` is an integer in `[0, 2^32)`, the same on every replay.
      The result is a dictionary of signals, `[time]` or `[time, k]`, with `dt` in seconds (or
      `times`, and `valid`, the number of valid samples); or an object with `.signals` and these as
      attributes. An error that it raises becomes a row with that message.
    - `token`: the server's token; the environment variable `VERIFAI_JAX_TOKEN` when left out. It is
      proved, not sent.
    - `capacity`: maximum number of points that may wait here.
    - `reconnect`: True to reconnect, however often, when the server goes away; a number of seconds
      after which to give up; or False.
    - `name`: the name of this client in the server's log.
    - `certificate`: for an encrypted connection (TLS), a PEM file with the server's certificate or
      that of the authority that signed it, or `"system"` for those that this machine trusts. The
      environment variable `VERIFAI_JAX_CERTIFICATE` when left out; without it the connection is not
      encrypted.
    **Raises:** `Refused` for a wrong token, another protocol or certificate, or a server that is
    not a run of verifai_jax; `ConnectionError` if no run could be reached and `reconnect` allows no
    more attempts; `ValueError` for a file that is not a certificate.
    """
    certificate = certificate or os.environ.get("VERIFAI_JAX_CERTIFICATE") or None
    tls = None if certificate is None else _trusting(certificate)
    token = os.environ.get("VERIFAI_JAX_TOKEN") if token is None else token
    patience = float("inf") if reconnect is True else float(reconnect)
    since, pause, served = time.monotonic(), SHORTEST_PAUSE, False
    while True:
        connection = None
        try:
            connection = _Connection(host, port, token, capacity, name, tls)
            connection.work(simulate)
        except KeyboardInterrupt:
            return
        except Refused:
            raise
        except (OSError, EOFError) as error:
            reason = error
        finally:
            if connection is not None:
                connection.socket.close()
        if connection is not None:
            since, pause, served = time.monotonic(), SHORTEST_PAUSE, True
        if time.monotonic() - since + pause > patience:
            if served:
                return
            raise ConnectionError(f"no run at {host}:{port} to simulate for: {reason}")
        if pause == SHORTEST_PAUSE:
            log.info("no run at %s port %s (%s); it is tried again", host, port, reason)
        try:
            time.sleep(pause)
        except KeyboardInterrupt:
            return
        pause = min(2 * pause, LONGEST_PAUSE)


def _trusting(certificate: str | os.PathLike[str]) -> ssl.SSLContext:
    file = None if certificate == "system" else os.fspath(certificate)
    try:
        return ssl.create_default_context(cafile=file)
    except (OSError, ssl.SSLError) as error:
        raise ValueError(f"{file!r} is not a certificate in a PEM file: {error}") from error


class _Connection:
    """One connection, from the greeting to its end."""

    def __init__(
        self, host: str, port: int, token: str | None, capacity: int, name: str | None,
        tls: ssl.SSLContext | None = None,
    ) -> None:  # fmt: skip
        self.socket = socket.create_connection((host, port), timeout=10.0)
        self.welcome = False  # Whether the server has handed out a point.
        self.capacity = capacity
        self._received = bytearray()
        self._max_bytes = GREETING_BYTES
        self._described = 0
        self._points: deque[dict[str, Any]] = deque()
        self._unsent: list[bytes] = []
        try:
            self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            # A run whose machine is gone is noticed within half a minute, where this can be set.
            for option, value in (("TCP_KEEPIDLE", 10), ("TCP_KEEPINTVL", 5), ("TCP_KEEPCNT", 3)):
                if hasattr(socket, option):
                    self.socket.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
            if tls is not None:
                self.socket = _encrypted(self.socket, tls, host)
            self._greet(token, name)
            self.socket.settimeout(None)
            self._max_bytes = MAX_BYTES
        except BaseException:
            self.socket.close()
            raise

    def work(self, simulate: Callable[[dict[str, Any], int], Any]) -> None:
        """Simulate until the server closes the connection."""
        self._take_up()  # What came along with its hello.
        flushed = time.monotonic()
        while True:
            while not self._points:
                self._flush()
                self._receive()
                flushed = time.monotonic()
            point = self._points.popleft()
            self._unsent.append(answer(point, simulate))
            overdue = time.monotonic() - flushed > FLUSH_SECONDS
            many = 4 * len(self._unsent) >= self.capacity
            if overdue or many or sum(map(len, self._unsent)) > FLUSH_BYTES:
                self._flush()
                flushed = time.monotonic()
                if self._readable():
                    self._receive()

    def _readable(self) -> bool:
        if isinstance(self.socket, ssl.SSLSocket) and self.socket.pending():
            return True  # What OpenSSL has decrypted already, `select` does not see.
        return bool(select.select([self.socket], [], [], 0)[0])

    def _greet(self, token: str | None, name: str | None) -> None:
        deadline = time.monotonic() + GREETING_SECONDS
        while (hello := self._frame()) is None:
            self.socket.settimeout(max(deadline - time.monotonic(), 1e-3))
            try:
                self._read()
            except (EOFError, TimeoutError) as error:
                if isinstance(self.socket, ssl.SSLSocket) or self._received:
                    raise
                hint = "a run with a certificate needs certificate=... here, too"
                raise EOFError(f"it says no hello ({error}); {hint}") from error
        if hello.get("type") == "error":
            raise _refusal(hello)
        if hello.get("type") != "hello" or hello.get("protocol") != PROTOCOL:
            spoken = plain(hello.get("protocol"))
            raise Refused(f"this client speaks protocol {PROTOCOL}, the server {spoken}")
        greeting: dict[str, Any] = {
            "type": "hello",
            "protocol": PROTOCOL,
            "capacity": self.capacity,
            "name": name or f"{socket.gethostname()}:{os.getpid()}",
        }
        if hello.get("challenge"):
            if token is None:
                raise Refused("the server asks for a token; give token=..., or VERIFAI_JAX_TOKEN")
            challenge = str(hello["challenge"]).encode()
            greeting["proof"] = hmac.new(token.encode(), challenge, hashlib.sha256).hexdigest()
        self.socket.sendall(_framed(greeting))

    def _flush(self) -> None:
        if self._unsent:
            data, self._unsent = b"".join(self._unsent), []
            self.socket.sendall(data)

    def _receive(self) -> None:
        """Wait for messages, and take up those that have come."""
        self._read()
        self._take_up()

    def _take_up(self) -> None:
        while (message := self._frame()) is not None:
            match message.get("type"):
                case "work":
                    self.welcome = True
                    self._points.extend(_points_of(message))
                    if len(self._points) > self.capacity:
                        raise _no_run(f"it sends more than {self.capacity} points")
                case "bye":
                    raise EOFError("the run has ended")
                case "error":
                    self._described += 1
                    if self._described <= MAX_LOGGED:
                        log.warning("the server says: %s", plain(message.get("message")))
                    if message.get("fatal") and not self.welcome:
                        raise _refusal(message)

    def _read(self) -> None:
        data = self.socket.recv(1 << 18)
        if not data:
            raise EOFError("the server has closed the connection")
        self._received += data

    def _frame(self) -> dict[str, Any] | None:
        if len(self._received) < 4:
            return None
        length = struct.unpack_from(">I", self._received)[0]
        if length > self._max_bytes:
            raise _no_run(f"it announces {length} bytes, more than {self._max_bytes}")
        end = 4 + length
        if len(self._received) < end:
            return None
        text = bytes(self._received[4:end])
        del self._received[:end]
        try:
            message = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise _no_run(f"it sends no JSON ({error})") from None
        if not isinstance(message, dict):
            raise _no_run(f"it sends {plain(message)}, no object")
        return message


def _encrypted(plain_socket: socket.socket, tls: ssl.SSLContext, host: str) -> ssl.SSLSocket:
    """Agree on keys with a server whose certificate is trusted."""
    try:
        return tls.wrap_socket(plain_socket, server_hostname=host)
    except ssl.SSLCertVerificationError as error:
        raise Refused(
            f"the certificate of the server is not trusted: {error.verify_message}"
        ) from error
    except (ssl.SSLEOFError, ssl.SSLZeroReturnError):
        raise  # It has closed the connection, and may be there another time.
    except ssl.SSLError as error:
        raise Refused(
            f"what answers there speaks no TLS, so it needs no certificate here: {error.reason}"
        ) from error


def _points_of(message: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the points of a `work` message."""
    points = message.get("points")
    if not isinstance(points, list):
        raise _no_run("it sends work without points")
    for point in points:
        if not isinstance(point, dict) or not isinstance(point.get("features"), dict):
            raise _no_run("it sends a point without features")
        if not (isinstance(point.get("id"), int) and isinstance(point.get("seed"), int)):
            raise _no_run("it sends a point without an integer id and seed")
    return points


def _refusal(message: dict[str, Any]) -> ConnectionError:
    kind = Full if message.get("retry") is True else Refused
    return kind(f"the server refuses: {plain(message.get('message'))}")


def _no_run(why: str) -> Refused:
    return Refused(f"the server there is not a run of verifai_jax: {why}")


def plain(text: object) -> str:
    """Convert a server's text to one line that cannot affect a log or a terminal."""
    if not isinstance(text, str):
        short = text is None or isinstance(text, bool | int | float)
        text = repr(text) if short else f"a {type(text).__name__}"
    line = "".join(c if c.isprintable() else " " for c in text[:301])
    return line if len(line) <= 300 else f"{line[:297]}..."


def answer(point: Mapping[str, Any], simulate: Callable[[dict[str, Any], int], Any]) -> bytes:
    """Simulate one point of a `work` message, and return the frame to send back."""
    owner = os.getpid()
    try:
        return encoded(point["id"], simulate(features_of(point["features"]), point["seed"]))
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # sys.exit() in a simulator is its failure, not our end.
        return _framed({"type": "result", "id": point["id"], "error": described(error)})
    finally:
        if os.getpid() != owner:
            os._exit(1)  # A forked copy of this process: its parent answers.


def described(error: BaseException) -> str:
    """Describe an error in one line, with the line of the simulator that raised it."""
    try:
        words = " ".join(str(error)[:3000].split())
    except Exception:  # `__str__` is code of the simulator too.
        words = "its text cannot be written"
    text = f"{type(error).__name__}: {words[:300]}{'...' * (len(words) > 300)}"
    libraries = (os.path.dirname(os.__file__), os.path.dirname(np.__path__[0]), __file__, "<")
    for step in reversed(traceback.extract_tb(error.__traceback__)):
        if not step.filename.startswith(libraries):
            return f"{text} ({step.filename}, line {step.lineno}, in {step.name})"
    return text


def features_of(value: object) -> Any:
    """Return features from JSON: lists as arrays, objects as `Waveform`s and `Reaction`s."""
    if isinstance(value, dict):
        needed = {"knots", "hold", "duration"}
        if needed <= value.keys() <= needed | {"times", "width"}:
            return Waveform(**value)
        if value.keys() == {"parameters", "inputs", "hidden", "bounds"}:
            return Reaction(**value)
        return {name: features_of(inner) for name, inner in value.items()}
    return np.asarray(value) if isinstance(value, list) else value


def _with_gaps(value: object) -> np.ndarray:
    """Return an array whose masked entries are NaN; NumPy's own conversion drops the mask."""
    if not isinstance(value, np.ma.MaskedArray) or not np.ma.getmaskarray(value).any():
        return np.asarray(value)
    return np.where(np.ma.getmaskarray(value), np.nan, np.asarray(value.data).astype(float))


def encoded(number: int, result: object) -> bytes:
    """Return a result as a frame whose arrays are raw bytes.

    **Raises:** `TypeError` for an object that is not a result.
    """
    if isinstance(result, Mapping):
        signals = result.get("signals")
        if not isinstance(signals, Mapping):
            signals = {name: v for name, v in result.items() if name not in RESERVED}
        about = {name: result.get(name) for name in RESERVED}
    else:
        signals = getattr(result, "signals", None)
        about = {name: getattr(result, name, None) for name in RESERVED}
    if not isinstance(signals, Mapping) or not signals:
        raise TypeError(
            "simulate must return a dictionary of signals and dt, such as {'x': x, 'dt': 0.02}; "
            f"it returned {type(result).__name__}"
        )
    raw: list[bytes] = []
    at = 0

    def packed(name: str, value: object) -> dict[str, Any]:
        nonlocal at
        array = _with_gaps(value)
        if array.dtype.kind not in "biuf":
            raise TypeError(f"{name} must be an array of numbers; got {array.dtype}")
        # The wire knows these; anything else (float16, unsigned) becomes a double.
        kind = array.dtype.newbyteorder("<").str
        if kind not in ("<f8", "<f4", "<i8", "<i4", "<i2", "|i1", "|u1", "|b1"):
            kind = "<f8"
        data = array.astype(kind, order="C", copy=False).tobytes()
        raw.append(data + bytes(-len(data) % 8))
        at += len(raw[-1])
        return {"$array": kind, "shape": array.shape, "at": at - len(raw[-1])}

    header: dict[str, Any] = {"type": "result", "id": number}
    header["signals"] = {str(name): packed(f"signal {name!r}", v) for name, v in signals.items()}
    if about["dt"] is not None:
        header["dt"] = float(about["dt"])
    if about["times"] is not None:
        header["times"] = packed("times", about["times"])
    if about["valid"] is not None:
        header["valid"] = int(about["valid"])
    return b"".join((_framed({**header, "bytes": at}), *raw))


def _framed(header: Mapping[str, Any]) -> bytes:
    text = json.dumps(header, separators=(",", ":")).encode()
    return struct.pack(">I", len(text)) + text


def address_of(text: str) -> tuple[str, int]:
    """Parse `HOST:PORT`, with an IPv6 address in brackets: `[::1]:4567`.

    **Raises:** `ValueError` for anything else.
    """
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal():
        raise ValueError(f"an address is HOST:PORT, such as 127.0.0.1:4567; got {text!r}")
    return host.removeprefix("[").removesuffix("]"), int(port)


def function_of(text: str) -> Callable[..., Any]:
    """Import the function named by `MODULE:NAME` or `FILE.py:NAME`.

    **Raises:** `ValueError` if there is none.
    """
    path, _, name = text.rpartition(":")
    if path.endswith(".py"):
        spec = importlib.util.spec_from_file_location(Path(path).stem, path)
        if spec is None or spec.loader is None or not Path(path).exists():
            raise ValueError(f"no file {path}")
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
    elif path:
        module = importlib.import_module(path)
    else:
        raise ValueError(f"a simulator is MODULE:FUNCTION or FILE.py:FUNCTION; got {text!r}")
    if not callable(getattr(module, name, None)):
        raise ValueError(f"{path} has no function {name!r}")
    return getattr(module, name)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line: `--address HOST:PORT MODULE:FUNCTION`."""
    parser = argparse.ArgumentParser(
        prog="remote_client", description="Simulate what a verifai_jax run asks for."
    )
    parser.add_argument("simulator", help="MODULE:FUNCTION or FILE.py:FUNCTION")
    parser.add_argument("--address", default="127.0.0.1:4567", help="HOST:PORT of the run")
    parser.add_argument("--capacity", type=int, default=32, help="points that may wait here")
    parser.add_argument("--processes", type=int, default=1, help="how many of these to run")
    parser.add_argument(
        "--reconnect", type=float, default=float("inf"), help="seconds to look for a run again"
    )
    parser.add_argument(
        "--certificate", help="PEM file of a certificate to trust, or 'system'; encrypts by TLS"
    )
    given = parser.parse_args(arguments)
    # Run by its path, the folder of this file would hide modules of other names: `trace`, `search`.
    here = str(Path(__file__).parent)
    sys.path[:] = [os.getcwd(), *(path for path in sys.path if path not in ("", here))]
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    try:
        host, port = address_of(given.address)
        simulate = function_of(given.simulator)
    except ValueError as error:
        parser.error(str(error))
    same = ["--address", given.address, "--capacity", str(given.capacity)]
    same += ["--reconnect", str(given.reconnect)]
    if given.certificate:
        same += ["--certificate", given.certificate]
    same.append(given.simulator)
    others = [
        subprocess.Popen([sys.executable, __file__, *same]) for _ in range(given.processes - 1)
    ]
    try:
        serve(
            simulate, host, port, capacity=given.capacity, reconnect=given.reconnect,
            certificate=given.certificate,
        )  # fmt: skip
    except (ConnectionError, ValueError) as error:
        print(error, file=sys.stderr)
        return 1
    finally:
        for other in others:
            other.terminate()
            other.wait()
    return 0


if __name__ == "__main__":
    sys.exit(main())
