"""`verifai-jax mcp`: the commands as tools of an agent, by the Model Context Protocol over pipes.

Messages are JSON-RPC 2.0, one a line. A tool runs a command in a separate process, with a budget of
simulations and of seconds. Paths are below one folder. Formulas in a message are only parsed; the
code that runs is in files of problems in that folder. For these few messages the SDK `mcp` would be
a dependency larger than this file.
"""

import contextlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import click

from verifai_jax._version import __version__
from verifai_jax.cli.exit_codes import CommandError
from verifai_jax.cli.json_output import output_to_errors
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.core.store.foreign_files import read_text
from verifai_jax.core.user_code.user_files import FENCE

VERSIONS = ("2025-11-25", "2025-06-18", "2025-03-26", "2024-11-05")
"""Versions of the protocol, the newest first."""
SHOWN = 8000
"""Characters of what people read, and of an error, that an answer has at most."""
MAX_MESSAGE = 1_000_000
"""Bytes of a message; of a longer one no more is read into memory."""
MAX_RESULT = 50_000_000
"""Bytes of a command's result that are read."""
POLL, PROGRESS = 0.1, 1.0
"""Seconds between two looks at a command that runs, and between two reports of its progress."""
OWN = "agent_problems"
"""Folder of the problems that `check` writes."""
NAME = r"[A-Za-z_][A-Za-z0-9_]{0,60}"
Schema = Mapping[str, Any]
PROBLEM = {"type": "string", "description": "A problem, FILE.py:NAME, of the folder."}
RUN = {"type": "string", "description": "The folder of a run, as falsify returned it."}
ROW = {"type": "integer", "minimum": 0, "description": "A row of the run; all when left out."}
SEED = {"type": "integer", "minimum": 0, "default": 0}
BUDGET = {"type": "integer", "minimum": 1, "default": 10_000, "description": "Simulations at most."}
WORD = {"type": "string", "pattern": f"^{NAME}$"}
FLAG = {"type": "boolean", "default": False}


class Tool(NamedTuple):
    """A command as a tool: its description, its arguments, and which of them follow the options."""

    description: str
    command: str
    arguments: Mapping[str, Schema]
    positional: tuple[str, ...]
    required: tuple[str, ...] = ()

    def schema(self) -> dict[str, Any]:
        """Return the schema of all arguments."""
        return {
            "type": "object", "properties": dict(self.arguments), "required": list(self.required),
            "additionalProperties": False,
        }  # fmt: skip


_RUN, _PROBLEM = ("run",), ("problem",)
TOOLS = {
    "list": Tool(
        "List the problems of a Python file or a folder, with features and formulas.", "list",
        {"location": {"type": "string", "default": "specs"}}, ("location",),
    ),
    "check": Tool(
        "Lint a formula on signals of a problem. With `name`, if nothing is suspicious, a problem "
        "with this formula is written, which the other tools take.", "formula lint",
        {"formula": {"type": "string", "maxLength": 2000}, "problem": PROBLEM, "name": WORD,
         "even_if_suspicious": FLAG}, ("formula",), ("formula", "problem"),
    ),
    "falsify": Tool(
        "Search for failures of a problem; returns the folder of the run, and the worst row.",
        "falsify", {"problem": PROBLEM, "budget": BUDGET, "seed": SEED, "search": WORD},
        _PROBLEM, _PROBLEM,
    ),
    "confirm": Tool(
        "Replay failures of a run in double precision, at finer steps, and by another engine.",
        "confirm", {"run": RUN, "row": ROW, "engine": WORD}, ("run", "row"), _RUN,
    ),
    "explain": Tool(
        "Say why a row of a run fails.", "explain --no-pictures", {"run": RUN, "row": ROW},
        ("run", "row"), _RUN,
    ),
    "shrink": Tool(
        "Find the failure nearest to the nominal values, beginning with a row of a run.",
        "shrink --no-pictures", {"run": RUN, "row": ROW, "budget": BUDGET}, ("run", "row"), _RUN,
    ),
    "estimate": Tool(
        "Estimate the probability of a failure, with an interval and a bound.", "estimate",
        {"problem": PROBLEM, "budget": BUDGET, "seed": SEED}, _PROBLEM, _PROBLEM,
    ),
    "report": Tool(
        "Write the evidence report on a run as an HTML file, and its claims as JSON.",
        "report --no-studies", {"run": RUN, "assessment": FLAG}, _RUN, _RUN,
    ),
    "trace": Tool(
        "Follow each requirement of a problem to its tests, runs, claims and reports.", "trace",
        {"problem": PROBLEM}, _PROBLEM, _PROBLEM,
    ),
}  # fmt: skip
KINDS = {"string": str, "integer": int, "boolean": bool}


class Refused(ValueError):
    """An error for arguments that a tool does not accept."""


class Cancelled(Exception):
    """An error for a call that the client, or the end of the server, has cancelled."""


class Call(NamedTuple):
    """A call of a tool: whether it was cancelled, and who gets the seconds that it has run."""

    cancelled: threading.Event
    report: Callable[[float], object] = lambda seconds: None


@dataclass
class Server:
    """A server of tools on one folder, which contains all paths.

    A call makes `budget` simulations at most, and takes so many `seconds`; all make `total`.
    """

    folder: Path
    budget: int
    total: int
    seconds: float
    spent: int = field(default=0, init=False)
    calls: dict[object, Call] = field(default_factory=dict, init=False)

    def serve(self, lines: Iterable[str | bytes], send: Callable[[str], object]) -> None:
        """Answer each request by `send`, as a line; no line ends the server.

        Tools run one after the other. Other messages are answered meanwhile.
        """
        sending = threading.Lock()

        def say(line: str | None) -> None:
            with sending:
                if line is not None:
                    send(line)

        with ThreadPoolExecutor(1) as pool:
            try:
                for line in lines:
                    if line.strip():
                        self._receive(line, say, pool)
            except BaseException:
                for call in tuple(self.calls.values()):
                    call.cancelled.set()
                raise

    def _receive(
        self, line: str | bytes, say: Callable[[str | None], None], pool: ThreadPoolExecutor
    ) -> None:
        try:
            request = json.loads(line, parse_constant=_refuse_constant)
        except (ValueError, RecursionError):
            message = f"the message is not JSON, or longer than {MAX_MESSAGE:,} bytes"
            return say(_line(None, error={"code": -32700, "message": message}))
        given = request if isinstance(request, dict) else {"id": None}
        number, method, params = given.get("id"), given.get("method"), given.get("params", {})
        whole = _is_id(number)
        valid = whole or "id" not in given
        if not valid or not isinstance(method, str) or not isinstance(params, dict):
            error = {"code": -32600, "message": "this is not a request"}
            return say(_line(number if whole else None, error=error))
        if "id" not in given:  # Nothing is answered to a notification.
            cancelled = params.get("requestId")
            call = self.calls.get(cancelled) if _is_id(cancelled) else None
            return None if call is None else call.cancelled.set()
        if method != "tools/call":
            return say(self._answer(number, method, params))
        if number in self.calls:
            error = {"code": -32600, "message": f"a call with the id {number!r:.80} is running"}
            return say(_line(None, error=error))
        about = params.get("_meta")
        token = about.get("progressToken") if isinstance(about, dict) else None

        def report(seconds: float) -> None:
            done = {"progressToken": token, "progress": seconds, "message": f"{seconds:z.0f} s"}
            say(json.dumps({"jsonrpc": "2.0", "method": "notifications/progress", "params": done}))

        call = Call(threading.Event(), *([report] if _is_id(token) else []))
        self.calls[number] = call

        def work() -> None:
            # Whatever goes wrong, the next message may be a good one.
            try:
                answer = self._called(number, params, call)
            except Cancelled:
                answer = None
            except Exception as error:
                text = f"{type(error).__name__}: {error}"[:SHOWN]
                answer = _line(number, error={"code": -32603, "message": text})
            del self.calls[number]
            say(answer)

        pool.submit(work)
        return None

    def _answer(self, number: object, method: str, params: Mapping[str, Any]) -> str:
        match method:
            case "initialize":
                asked = params.get("protocolVersion")
                return _line(number, result={
                    "protocolVersion": asked if asked in VERSIONS else VERSIONS[0],
                    "capabilities": {"tools": {}},
                    "serverInfo": {"name": "verifai-jax", "version": __version__},
                    "instructions": "list, check a formula, falsify, confirm, estimate, report.",
                })  # fmt: skip
            case "ping":
                return _line(number, result={})
            case "tools/list":
                tools = [
                    {"name": name, "description": tool.description, "inputSchema": tool.schema()}
                    for name, tool in TOOLS.items()
                ]
                return _line(number, result={"tools": tools})
        return _line(number, error={"code": -32601, "message": f"no method {method!r:.80}"})

    def _called(self, number: object, params: Mapping[str, Any], call: Call) -> str:
        if call.cancelled.is_set():
            raise Cancelled
        name, given = params.get("name"), params.get("arguments") or {}
        if not isinstance(name, str) or name not in TOOLS or not isinstance(given, dict):
            text = f"there is no tool {name!r:.80}; there are {', '.join(TOOLS)}"
            return _line(number, error={"code": -32602, "message": text})
        return _line(number, result=self.call(name, given, call))

    def call(self, name: str, given: Mapping[str, Any], call: Call | None = None) -> dict[str, Any]:
        """Call a tool; errors are part of its answer, for the agent to read."""
        try:
            return self._call(name, TOOLS[name], given, call or Call(threading.Event()))
        except (ValueError, OSError) as error:
            return _content(str(error), {}, failed=True)

    def _call(self, name: str, tool: Tool, given: Mapping[str, Any], call: Call) -> dict[str, Any]:
        values = checked(tool, given)
        for key in ("problem", "location", "run"):
            if key in values:
                self._fence(key, values[key])
        if "budget" in values:
            left = min(self.budget, self.total - self.spent)
            if values["budget"] > left:
                text = f"a budget of {values['budget']:,} simulations is too large"
                raise Refused(f"{text}: {left:,} are left for this call")
            self.spent += values["budget"]
        options = [
            f"--{key}" if value is True else f"--{key}={value}"
            for key, value in values.items()
            if key not in (*tool.positional, "name", "even_if_suspicious") and value is not False
        ]
        after = [str(values[key]) for key in tool.positional if key in values]
        words = [*tool.command.split(), "--json", *options, "--", *after]
        code, said, shown = self._run(words, call)
        text = shown.decode("utf-8", "replace")[-SHOWN:].strip()
        try:
            result = json.loads(said or b"{}")
        except ValueError:
            result = {}
        failed = code not in (0, 1)
        result["command"] = shlex.join(["verifai-jax", *words])
        if name == "check" and "name" in values and not failed:
            if result.get("findings") and not values["even_if_suspicious"]:
                text += "\nNo problem was written, as the formula is suspicious."
            else:
                result["problem"] = self._write(values)
        return _content(text, result, failed)

    def _run(self, words: list[str], call: Call) -> tuple[int, bytes, bytes]:
        """Run a command; return its exit code, its result, and the end of what people read."""
        begun, reported = time.monotonic(), 0.0
        # Files, since a process that the command leaves behind could keep a pipe open.
        with tempfile.TemporaryFile() as result, tempfile.TemporaryFile() as shown:
            process = subprocess.Popen(
                [sys.executable, "-m", "verifai_jax", *words], cwd=self.folder,
                stdin=subprocess.DEVNULL, stdout=result, stderr=shown, start_new_session=True,
                env={**os.environ, "MPLBACKEND": "agg", FENCE: str(self.folder)},
            )  # fmt: skip
            try:
                while process.poll() is None:
                    if call.cancelled.wait(POLL):
                        raise Cancelled
                    passed = time.monotonic() - begun
                    if passed > self.seconds:
                        after = f"{self.seconds:zg} s"
                        raise Refused(f"it was ended after {after}; take a smaller budget")
                    if passed - reported >= PROGRESS:
                        reported = passed
                        call.report(passed)
            finally:
                if os.name == "posix":  # With all that it has started.
                    with contextlib.suppress(ProcessLookupError, PermissionError):
                        os.killpg(process.pid, signal.SIGKILL)
                process.kill()
                process.wait()
            result.seek(0)
            shown.seek(max(0, shown.seek(0, os.SEEK_END) - 4 * SHOWN))
            return process.returncode, result.read(MAX_RESULT), shown.read()

    def _fence(self, key: str, value: str) -> None:
        """Refuse a path outside of the folder, and a problem that is not in a file of it."""
        path = value.rpartition(":")[0] if key == "problem" and ":" in value else value
        whole = (self.folder / path).resolve()
        if not whole.is_relative_to(self.folder) or not whole.exists() or path.startswith("-"):
            raise Refused(f"{key} {value!r} does not exist in the folder of this server")
        if key == "problem" and whole.suffix != ".py":
            raise Refused(f"problem {value!r} must be FILE.py:NAME")

    def _write(self, values: Mapping[str, Any]) -> str:
        """Write a problem with another formula, and return its target."""
        name = values["name"]
        path = self.folder / OWN / f"{name}.py"
        if not path.resolve().is_relative_to(self.folder):
            raise Refused(f"{OWN} leads out of the folder of this server")
        text = (
            "from dataclasses import replace\n\nimport verifai_jax as vj\n"
            "from verifai_jax.core.user_code.targets import load_target\n\n"
            f"base = load_target({values['problem']!r}, vj.Problem)\n"
            f"problem = replace(\n    base,\n    name={name!r},\n"
            f"    spec={{{name!r}: {values['formula']!r}}},\n"
            "    priority=None,\n    requirements=None,\n)\ndel base\n"
        )
        if path.exists() and read_text(path) != text:
            raise Refused(f"there is another problem {name!r} in {OWN}: take another name")
        with replacing(path) as partial:
            partial.write_text(text, encoding="utf-8")
        return f"{OWN}/{name}.py:{name}"


def checked(tool: Tool, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of a call, completed by defaults.

    **Raises:** `Refused` for an argument that is unknown, missing, or does not fit its schema.
    """
    for name in given:
        if name not in tool.arguments:
            raise Refused(f"there is no argument {name!r}; there are {', '.join(tool.arguments)}")
    values = {}
    for name, schema in tool.arguments.items():
        if name not in given and "default" not in schema:
            if name in tool.required:
                raise Refused(f"the argument {name!r} is missing")
            continue
        value = given.get(name, schema.get("default"))
        kind = KINDS[schema["type"]]
        if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
            raise Refused(f"{name} must be of type {schema['type']}; got {value!r}")
        if isinstance(value, str) and len(value) > schema.get("maxLength", 500):
            raise Refused(f"{name} is too long")
        if isinstance(value, str) and re.search("[\0\ud800-\udfff]", value):
            raise Refused(f"{name} has a character that no argument can have; got {value!r}")
        if "pattern" in schema and not re.fullmatch(schema["pattern"], str(value)):
            raise Refused(f"{name} must match {schema['pattern']}; got {value!r}")
        if isinstance(value, int) and value < schema.get("minimum", 0):
            raise Refused(f"{name} must be at least {schema['minimum']}; got {value}")
        values[name] = value
    return values


def _content(text: str, result: Mapping[str, Any], failed: bool) -> dict[str, Any]:
    parts = [{"type": "text", "text": each} for each in (text, json.dumps(result)) if each != "{}"]
    return {"content": parts, "structuredContent": dict(result), "isError": failed}


def _is_id(value: object) -> bool:
    return isinstance(value, str | int) and not isinstance(value, bool)


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not JSON")


def _line(number: object, **answer: object) -> str:
    return json.dumps({"jsonrpc": "2.0", "id": number, **answer})


@click.command()
@click.option(
    "--folder", type=click.Path(path_type=Path), default=".", help="Folder of the project."
)
@click.option(
    "--budget", type=click.IntRange(1), default=100_000, help="Maximum simulations in a call."
)
@click.option(
    "--total", type=click.IntRange(1), default=1_000_000, help="Maximum simulations in all."
)
@click.option(
    "--seconds", type=click.FloatRange(1), default=600.0, help="Maximum seconds for a call."
)
def mcp(folder: Path, budget: int, total: int, seconds: float) -> None:
    """Serve an agent over standard input and output, by the Model Context Protocol.

    Its paths are below the folder, and its simulations and seconds at most as many.
    """
    if not folder.is_dir():
        raise CommandError(f"there is no folder {folder}", 2)
    with output_to_errors() as out:

        def send(line: str) -> None:
            out.write(f"{line}\n")
            out.flush()

        Server(folder.resolve(), budget, total, seconds).serve(messages(sys.stdin.buffer), send)


def messages(stream: BinaryIO) -> Iterator[bytes]:
    """Yield lines; of one that is too long only its beginning, which is not JSON."""
    while line := stream.readline(MAX_MESSAGE):
        yield line
        while not line.endswith(b"\n") and line:
            line = stream.readline(MAX_MESSAGE)
