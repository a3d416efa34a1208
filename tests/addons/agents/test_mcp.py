"""An agent over pipes: a whole study, and what the server refuses."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from verifai_jax.addons.agents.mcp import TOOLS, Server

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


def answers(folder, *lines):
    return [json.loads(line) for line in server(folder).answers(lines)]


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
    def plain(name):
        raise AssertionError(f"{name} is not JSON")

    (folder / "loop").symlink_to(folder / "loop")
    lines = server(folder).answers([line, request(2, "ping")])
    first, second = (json.loads(each, parse_constant=plain) for each in lines)
    assert first.get("error") or first["result"]["isError"]
    assert second == {"jsonrpc": "2.0", "id": 2, "result": {}}


@pytest.mark.slow
def test_only_files_of_the_folder_are_run_and_only_the_result_is_on_descriptor_1(folder):
    outside = folder.parent / "outside.py"
    outside.write_text(f"open({str(folder / 'ran')!r}, 'w')")
    (folder / "tests").mkdir()
    for place in ("specs/link.py", "tests/test_link.py"):
        (folder / place).symlink_to(outside)
    noise = "import ctypes, os\nctypes.CDLL(None).printf(b'from C')\nos.write(1, b'raw')\n"
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
        ("falsify", {"problem": "specs/a\0.py:x"}, "does not exist in the folder of this server"),
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
