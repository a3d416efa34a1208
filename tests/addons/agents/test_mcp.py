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
    return [json.loads(line) for line in server(folder).answers(iter(lines))]


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
