"""Formulas on the lines of a stream: certain verdicts as soon as they are, and bad lines."""

import numpy as np
import pytest
from click.testing import CliRunner

from verifai_jax.addons.monitoring.commands.monitor import monitor_stream
from verifai_jax.cli.exit_codes import CommandError
from verifai_jax.cli.main import main
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import parse, robustness, satisfied

LINES = ["time,dist,p[0],p[1]", "0,5,3,4", "0.5,3,0,0", "1,0,1,1", "1.5,-2,1,1", "2,7,1,1"]


def follow(text, lines=LINES, **options):
    shown = []
    read = []

    def reading():
        for line in lines:
            read.append(line)
            yield line + "\n"

    options = {"time": "time", "dt": None} | options
    holds = monitor_stream(parse(text), reading(), show=shown.append, **options)
    return holds, shown[0], len(read)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("text", "says", "lines"),
    [
        ("always dist > -1", "whatever follows 1.5 s, it fails, with robustness at most -1", 5),
        ("always dist > 0", "whatever follows 1 s, it fails, with robustness at most 0", 4),
        ("F[0,0.5] dist < 4", "whatever follows 0.5 s, it holds, with robustness at least 1", 3),
        ("F norm(p) >= 5", "whatever follows 0 s, it holds, with robustness at least 0", 3),
        (
            "always dist >= -2",
            "undecided at the end: with the last of 5 samples held, it holds with robustness 0",
            6,
        ),
    ],
)
def test_the_verdict_comes_with_the_sample_that_decides(text, says, lines):
    holds, said, read = follow(text)
    assert (said, read) == (says, lines)
    cells = np.array([line.split(",") for line in LINES[1:]], float)
    trace = Trace({"dist": cells[:, 1], "p": cells[:, 2:]}, dt=0.5)
    assert holds == bool(satisfied(text, trace))
    if "undecided" in says:
        assert float(robustness(text, trace)) == 0


@pytest.mark.parametrize(
    ("lines", "options", "message"),
    [
        ([], {}, "is empty; its first line has the names"),
        (["t,dist", "0,1"], {}, "no column 'time' of sample times. Give the sampling period, --dt"),
        (["time,dst", "0,1"], {}, "no column 'dist'; did you mean 'dst'"),
        (["time,dist", "0,1"], {}, "has 1 sample, too few to show the sampling period"),
        (["time,dist", "0,1", "0,2"], {}, "must increase; line 2 of the standard input has 0 s"),
        (["time,dist", "0,1", "1"], {}, "line 3 of the standard input has 1 cells, and the first"),
        (["dist", "x"], {"dt": 0.1}, "line 2 of the standard input has 'x' in column 'dist'"),
        (["dist", "1"], {"dt": -0.1}, "dt must be positive"),
    ],
)
def test_bad_lines_are_named(lines, options, message):
    with pytest.raises(ValueError, match=r".") as caught:
        follow("always dist > 0", lines, **options)
    assert message in str(caught.value)


@pytest.mark.thorough
def test_gaps_and_uneven_times_end_it():
    with pytest.raises(CommandError, match="signal 'dist' is NaN at 0 s"):
        follow("always dist > 0", ["dist", '""'], dt=0.5)
    with pytest.raises(ValueError, match=r"line 4 of the standard input is at 1\.2 s, where 1 s"):
        follow("always dist > 0", ["time,dist", "0,1", "0.5,1", "1.2,1"])
    with pytest.raises(
        ValueError, match=r"if its times are rounded, give the period, --dt SECONDS"
    ):
        follow("always dist > 0", ["time,dist", "0,1", "0.033,1", "0.067,1"])


def test_options_that_need_the_whole_recording_are_refused():
    result = CliRunner().invoke(main, ["monitor", "always x > 0", "-", "--explain"], input="x\n")
    assert result.exit_code == 2
    assert "other options need the whole recording" in result.output


def test_a_formula_becomes_a_monitor_in_c(tmp_path):
    file = tmp_path / "keep-gap.h"
    result = CliRunner().invoke(
        main,
        ["monitor", "always gap > near", "--const", "near=2", "--dt", "0.1", "--export-c", file],
    )
    assert result.exit_code == 0, result.output
    assert "static inline void keep_gap_step(keep_gap *m, const double x[1])" in file.read_text()
    for options in (["--dt", "0.1", "log.csv"], []):
        result = CliRunner().invoke(main, ["monitor", "x > 0", "--export-c", file, *options])
        assert "--export-c goes with --dt SECONDS, and with no RECORDING" in result.output
    result = CliRunner().invoke(main, ["monitor", "x > 0"])
    assert "give a RECORDING to judge, or --export-c FILE.h" in result.output


def test_a_gap_keeps_the_last_value_if_that_is_asked_for():
    lines = ["time,dist,p[0],p[1]", "0,5,3,4", "0.5,,nan,0", "1,-1,1,"]
    holds, said, read = follow("always (dist > -1 & norm(p) < 9)", lines, hold=True)
    assert (holds, read) == (False, 4)
    assert said == "whatever follows 1 s, it fails, with robustness at most 0"
    assert follow("always (p[0] > 2 | dist < 5)", lines, hold=True)[2] == 4
    with pytest.raises(CommandError, match=r"signal 'dist' is NaN at 0\.5 s"):
        follow("always dist > -2", lines)
    assert follow("always dist > -1", lines)[1] == said  # Whatever the gap hid.
    with pytest.raises(CommandError, match="signal 'dist' is NaN at 0 s"):
        follow("always dist > -1", ["time,dist", "0,", "1,2"], hold=True)


@pytest.mark.parametrize(
    ("missing", "why"),
    [
        ("drop", "leaves instants out, and samples of a stream are evenly spaced"),
        ("interpolate", "needs the value after a gap, which a stream has not had yet"),
    ],
)
def test_a_treatment_of_gaps_that_no_stream_allows_says_why(missing, why):
    command = ["monitor", "always dist > 1", "-", "--missing", missing]
    result = CliRunner().invoke(main, command, input="time,dist\n0,5\n1,4\n")
    assert result.exit_code == 2
    assert f"--missing {missing} {why}: use --missing hold" in " ".join(result.output.split())
    held = CliRunner().invoke(
        main, [*command[:3], "--missing", "hold"], input="time,dist\n0,5\n1,\n"
    )
    assert held.exit_code == 0
    assert "undecided at the end" in held.output
