"""An agent over pipes: a whole study, and what the server refuses."""

import contextlib
import json
import os
import random
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from verifai_jax.addons.agents.mcp import TOOLS, Server, messages

SPEC = """
import numpy as np
import verifai_jax as vj

def simulate(features):
    t = np.arange(8) * 0.1
    return vj.Trace({"gap": 2.0 - features["v"] * t * 4, "speed": features["v"] + 0 * t}, dt=0.1)

brake = vj.Problem(
    "brake", {"v": vj.Box(0.0, 1.0)}, vj.blackbox(simulate), "always gap > 0", nominal={"v": 0.1},
)
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "specs").mkdir()
    (tmp_path / "specs" / "brake.py").write_text(SPEC)
    (tmp_path / "specs" / "notes.txt").write_text("nothing")
    return tmp_path


def server(folder, **options):
    return Server(folder.resolve(), **{"budget": 500, "total": 600, "seconds": 100.0} | options)


def request(number, method, **params):
    return json.dumps({"jsonrpc": "2.0", "id": number, "method": method, "params": params}) + "\n"


def plain(name):
    raise AssertionError(f"{name} is not JSON")


def serve(serving, lines):
    """Return the answers: the calls of tools last, since other messages do not wait for them."""
    said = []
    serving.serve(lines, lambda line: said.append(json.loads(line, parse_constant=plain)))
    return sorted(said, key=lambda answer: "content" in answer.get("result", {}))


def answers(folder, *lines):
    return serve(server(folder), lines)


def test_messages(folder):
    first, ping, unknown, broken, odd, tool = answers(
        folder,
        request(1, "initialize", protocolVersion="2025-06-18", capabilities={}, clientInfo={}),
        '{"jsonrpc": "2.0", "method": "notifications/initialized"}\n',
        request("a", "ping"),
        request(3, "resources/list"),
        "{nothing\n",
        "[1]\n",
        request(4, "tools/call", name="shell", arguments={}),
    )
    assert first["result"]["protocolVersion"] == "2025-06-18"
    assert first["result"]["capabilities"] == {"tools": {}}
    assert ping == {"jsonrpc": "2.0", "id": "a", "result": {}}
    assert unknown["error"]["code"] == -32601
    assert (broken["id"], broken["error"]["code"]) == (None, -32700)
    assert odd["error"]["code"] == -32600
    assert tool["error"] == {"code": -32602, "message": tool["error"]["message"]}
    assert "there is no tool 'shell'; there are list, check" in tool["error"]["message"]
    (newest,) = answers(folder, request(1, "initialize", protocolVersion="1999-01-01"))
    assert newest["result"]["protocolVersion"] == "2025-11-25"


HOSTILE = [
    "[" * 100_000,
    '{"a":' * 100_000,
    '{"id": NaN, "method": "ping"}',
    '{"id": 1e999, "method": "ping"}',
    '{"id": [], "method": "ping"}',
    '{"id": true, "method": "ping"}',
    '{"id": ' + "9" * 5000 + ', "method": "ping"}',
    '{"id": 1, "method": "ping", "params": null}',
    '{"id": 1, "method": "tools/call", "params": {"name": []}}',
    '{"id": 1, "method": "tools/call", "params": {"name": {"a": 1}}}',
    request(1, "tools/call", name="list", arguments={"location": "\ud800"}),
    request(1, "tools/call", name="list", arguments={"location": "loop"}),
    request(1, "tools/call", name="list", arguments={"location": "a" * 450}),
]


@pytest.mark.parametrize("line", HOSTILE, ids=lambda line: line[:60])
def test_no_message_ends_the_server(folder, line):
    (folder / "loop").symlink_to(folder / "loop")
    both = answers(folder, line, request(2, "ping"))
    assert {"jsonrpc": "2.0", "id": 2, "result": {}} in both
    (first,) = (each for each in both if each["id"] != 2)
    assert first.get("error") or first["result"]["isError"]


class FakeRuns(Server):
    """A server whose commands do nothing, at once."""

    def _run(self, words, call):
        subprocess.list2cmdline(words).encode()
        return 0, b"{}", b""


def random_value(rng, depth=3):
    names = ("id", "method", "params", "name", "arguments", "_meta", "progressToken", "requestId")
    methods = ("tools/call", "ping", "notifications/cancelled")
    given = ("problem", "specs/brake.py:brake", "formula", "x > 0", "location", "..")
    words = (*names, *TOOLS, *methods, *given, "\0", "\ud800", "\u202e", "")
    kinds = ("word", "number", "constant", *(("list", "object") if depth else ()))
    match rng.choice(kinds):
        case "word":
            return rng.choice(words)
        case "number":
            return rng.choice((0, -1, 1, 2, 1.5, 1e308, 10**400, -0.0))
        case "constant":
            return rng.choice((None, True, False, float("nan"), float("inf")))
        case "list":
            return [random_value(rng, depth - 1) for _ in range(rng.randrange(4))]
    return {rng.choice(words): random_value(rng, depth - 1) for _ in range(rng.randrange(6))}


def random_message(rng):
    params = random_value(rng)
    if rng.random() < 0.5:
        params = {"name": rng.choice([*TOOLS, []]), "arguments": random_value(rng)}
    message = {"jsonrpc": "2.0", "id": rng.choice((1, 2, "a", random_value(rng))), "params": params,
               "method": rng.choice(("tools/call", "ping", "tools/list", "initialize", "nothing",
                                     "notifications/cancelled", random_value(rng)))}  # fmt: skip
    for name in rng.sample(sorted(message), rng.randrange(3)):
        message[name] = random_value(rng)
    line = bytearray(json.dumps(message).encode())
    for _ in range(rng.choice((0, 0, 1, 8))):
        line[rng.randrange(len(line))] = rng.randrange(256)
    return bytes(line).replace(b"\n", b" ").replace(b"\r", b" ") + b"\n"


@pytest.mark.parametrize("count", [50, pytest.param(500, marks=pytest.mark.slow)])
def test_random_messages(folder, count):
    rng = random.Random(7)
    serving = FakeRuns(folder.resolve(), budget=500, total=600, seconds=100.0)
    said = serve(serving, [*(random_message(rng) for _ in range(count)), request("last", "ping")])
    assert {"jsonrpc": "2.0", "id": "last", "result": {}} in said
    assert not [each for each in said if each.get("error", {}).get("code") == -32603]
    assert not serving.calls


def test_a_long_line_is_not_read_whole(folder):
    huge = 40 * b"x" * 1_000_000 + b"\n"
    with os.fdopen(os.memfd_create("lines"), "r+b") as lines:
        lines.write(huge + b"\xff\xfe\n" + request(2, "ping").encode())
        lines.seek(0)
        said = answers(folder, *messages(lines))
        assert max(map(len, (lines.seek(0), *messages(lines))[1:])) <= 1_000_000
    assert [each["id"] for each in said] == [None, None, 2]
    assert {each["error"]["code"] for each in said[:2]} == {-32700}


WAITS = """
import os, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
open("started.part", "w").write(str(child.pid))
os.rename("started.part", "started")
time.sleep(600)
"""


def is_alive(process):
    with contextlib.suppress(OSError):
        return Path(f"/proc/{process}/stat").read_text().split()[2] != "Z"
    return False


@pytest.mark.slow
def test_a_call_is_cancelled_with_what_it_started_and_pings_are_answered_meanwhile(folder):
    (folder / "specs" / "brake.py").write_text(WAITS)
    heard = []

    def lines():
        yield json.dumps({"id": 1, "method": "tools/call", "params": {
            "name": "list", "arguments": {}, "_meta": {"progressToken": "p"}}})  # fmt: skip
        while not (folder / "started").exists() or len(heard) < 2:
            time.sleep(0.05)
        yield request(1, "tools/call", name="list", arguments={})
        yield request(2, "ping")
        assert heard[-1]["id"] == 2
        yield json.dumps({"method": "notifications/cancelled", "params": {"requestId": 1}})

    server(folder).serve(lines(), lambda line: heard.append(json.loads(line)))
    *reports, twice, ping = heard
    assert {each["method"] for each in reports} == {"notifications/progress"}
    seconds = [each["params"]["progress"] for each in reports]
    assert seconds == sorted(set(seconds))
    assert "a call with the id 1 is running" in twice["error"]["message"]
    assert ping == {"jsonrpc": "2.0", "id": 2, "result": {}}
    child = (folder / "started").read_text()
    deadline = time.monotonic() + 10
    while is_alive(child) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not is_alive(child)


def test_a_call_that_waits_is_cancelled_and_costs_nothing(folder):
    begun, go = threading.Event(), threading.Event()

    class Slow(FakeRuns):
        def _run(self, words, call):
            begun.set()
            assert go.wait(10)
            return super()._run(words, call)

    def lines():
        given = {"problem": "specs/brake.py:brake", "budget": 100}
        yield request(1, "tools/call", name="falsify", arguments=given)
        yield request(2, "tools/call", name="falsify", arguments=given)
        assert begun.wait(10)
        yield json.dumps({"method": "notifications/cancelled", "params": {"requestId": 2}})
        go.set()

    serving = Slow(folder.resolve(), budget=500, total=600, seconds=100.0)
    assert [each["id"] for each in serve(serving, lines())] == [1]
    assert serving.spent == 100


@pytest.mark.slow
def test_only_files_of_the_folder_are_run_and_only_the_result_is_on_descriptor_1(folder):
    outside = folder.parent / "outside.py"
    outside.write_text(f"open({str(folder / 'ran')!r}, 'w')")
    (folder / "tests").mkdir()
    for place in ("specs/link.py", "tests/test_link.py"):
        (folder / place).symlink_to(outside)
    noise = (
        "import atexit, ctypes, os, subprocess\nctypes.CDLL(None).printf(b'from C')\n"
        "os.write(1, b'raw')\nsubprocess.run(['echo', 'from a process'])\n"
        "atexit.register(os.write, 1, b'at the end')\n"
    )
    (folder / "specs" / "brake.py").write_text(noise + SPEC)
    serving = server(folder)
    listed = serving.call("list", {})
    (target,) = (each["target"] for each in listed["structuredContent"]["targets"])
    assert target == "specs/brake.py:brake"
    assert "specs/link.py leads out of" in listed["content"][0]["text"]
    traced = serving.call("trace", {"problem": target})
    assert "tests/test_link.py leads out of" in traced["content"][0]["text"]
    assert not (folder / "ran").exists()
    (folder / "agent_problems").symlink_to(folder.parent)
    with pytest.raises(ValueError, match="agent_problems leads out of the folder"):
        serving._write({"name": "outside", "problem": target, "formula": "x > 0"})


def test_each_tool_has_a_schema(folder):
    (listed,) = answers(folder, request(1, "tools/list"))
    assert {each["name"] for each in listed["result"]["tools"]} == set(TOOLS)
    for each in listed["result"]["tools"]:
        schema = each["inputSchema"]
        assert set(schema["required"]) <= set(schema["properties"])
        assert schema["additionalProperties"] is False
        assert each["description"].endswith(".")


@pytest.mark.parametrize(
    ("tool", "given", "text"),
    [
        ("falsify", {}, "the argument 'problem' is missing"),
        ("falsify", {"problem": "../x.py:p"}, "does not exist in the folder of this server"),
        ("falsify", {"problem": "/etc/passwd"}, "does not exist in the folder of this server"),
        ("falsify", {"problem": "os:path"}, "does not exist in the folder of this server"),
        ("falsify", {"problem": "specs/notes.txt:x"}, "must be FILE.py:NAME"),
        ("falsify", {"problem": "specs/link.py:x"}, "does not exist in the folder of this server"),
        ("falsify", {"problem": "--help"}, "does not exist in the folder of this server"),
        ("falsify", {"problem": "specs/a\0.py:x"}, "a character that no argument can have"),
        ("falsify", {"problem": "specs/brake.py:brake", "budget": 501}, "500 are left"),
        (
            "falsify",
            {"problem": "specs/brake.py:brake", "budget": True},
            "of type integer; got True",
        ),
        ("falsify", {"problem": "specs/brake.py:brake", "search": "a b"}, "search must match"),
        ("falsify", {"problem": "specs/brake.py:brake", "folder": "/tmp"}, "no argument 'folder'"),
        ("confirm", {"run": "/tmp"}, "does not exist in the folder of this server"),
        ("confirm", {"run": "specs", "row": -1}, "row must be at least 0; got -1"),
        ("list", {"location": "/"}, "does not exist in the folder of this server"),
        ("check", {"formula": "x" * 3000, "problem": "specs/brake.py"}, "formula is too long"),
        (
            "check",
            {"formula": "x < 1", "problem": "specs/brake.py", "name": "a\n"},
            "name must match",
        ),
    ],
)
def test_what_is_refused(folder, tool, given, text):
    outside = folder.parent / "outside.py"
    outside.write_text("raise SystemExit('it ran')")
    (folder / "specs" / "link.py").symlink_to(outside)
    said = server(folder).call(tool, given)
    assert said["isError"]
    assert text in said["content"][0]["text"]


class Client:
    """A client over pipes."""

    def __init__(self, folder: Path) -> None:
        command = [sys.executable, "-m", "verifai_jax", "mcp", "--folder", str(folder),
                   "--budget", "500", "--total", "1200"]  # fmt: skip
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.number = 0

    def ask(self, method, **params):
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.number += 1
        self.process.stdin.write(request(self.number, method, **params))
        self.process.stdin.flush()
        answer = json.loads(self.process.stdout.readline())
        assert answer["id"] == self.number
        return answer["result"]

    def tool(self, name, /, **given):
        return self.ask("tools/call", name=name, arguments=given)


@pytest.mark.slow
def test_a_whole_study(folder):
    client = Client(folder)
    client.ask("initialize", protocolVersion="2025-06-18", capabilities={}, clientInfo={})
    found = client.tool("list", location="specs")["structuredContent"]
    (target,) = [each["target"] for each in found["targets"]]

    wrong = client.tool("check", problem=target, formula="always gap >")
    assert wrong["isError"]
    vain = client.tool("check", problem=target, formula="always gap > -100", name="vain")
    assert vain["structuredContent"]["findings"]
    assert "problem" not in vain["structuredContent"]
    good = client.tool("check", problem=target, formula="always gap > 0.5", name="half")
    assert good["structuredContent"]["problem"] == "agent_problems/half.py:half", good
    half = good["structuredContent"]["problem"]

    found = client.tool("falsify", problem=half, budget=300, search="uniform", seed=1)
    assert not found["isError"], found
    run = found["structuredContent"]["folder"]
    assert found["structuredContent"]["command"].startswith("verifai-jax falsify")
    real = client.tool("confirm", run=run)["structuredContent"]
    assert real["confirmed"] == real["examined"] > 0
    assert not client.tool("explain", run=run)["isError"]
    assert not client.tool("shrink", run=run, budget=50)["isError"]
    rate = client.tool("estimate", problem=half, budget=400)["structuredContent"]
    assert rate["low"] < 0.5 < rate["high"] + 0.2
    paper = client.tool("report", run=run)["structuredContent"]
    assert (folder / paper["report"]).exists()
    links = client.tool("trace", problem=half)["structuredContent"]
    assert links["rows"][0]["runs"] == [run]
    left = client.tool("falsify", problem=half, budget=500)
    assert "450 are left for this call" in left["content"][0]["text"]
    with client.process:  # Closes the pipes, and waits.
        pass
    assert client.process.returncode == 0
