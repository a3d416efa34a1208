"""From requirement to report: what is there, what is missing, what has changed since."""

import json
import re
import sys

import jax.numpy as jnp
import pytest
from click.testing import CliRunner

import verifai_jax as vj
from verifai_jax.cli.main import main
from verifai_jax.mtl import Requirement, parse, read_requirements, write_requirements

REQUIREMENTS = """
constants: {{far: 0.0}}
requirements:
  - id: REQ-1
    text: {text}
    source: ISO 15622, 6.2
    severity: S3
    links: [SYS-4, SYS-5]
  - id: REQ-2
    text: It is never fast.
"""
SPEC = """
import jax.numpy as jnp
import verifai_jax as vj

def simulate(features, key):
    t = jnp.arange(8) * 0.1
    return vj.Trace({{"gap": {gap} - features["v"] * t, "speed": features["v"] + 0 * t}}, dt=0.1)

brake = vj.Problem(
    "brake", {{"v": vj.Box(0.0, 1.0)}}, simulate,
    {{"REQ-1": "{first}", "REQ-2": "always speed < 2"}},
    requirements="requirements.yaml",
)
"""
TEST = """
import verifai_jax as vj
@vj.test("specs/brake.py:brake", budget=8)
def test_brake(): ...
"""


def write_spec(gap="2.0", first="always gap > 0", text="The gap stays positive."):
    with open("specs/brake.py", "w") as file:
        file.write(SPEC.format(gap=gap, first=first))
    with open("requirements.yaml", "w") as file:
        file.write(REQUIREMENTS.format(text=text))


def traced():
    """Trace as another process would: nothing that was imported before is known."""
    from verifai_jax.addons.checking._test import load, problems_of

    load.cache_clear()
    problems_of.cache_clear()
    return vj.trace_matrix("specs/brake.py", tests=["tests"], runs=["runs"], reports=["reports"])


@pytest.fixture
def project(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for folder in ("specs", "tests", "runs", "reports"):
        (tmp_path / folder).mkdir()
    write_spec()
    (tmp_path / "tests" / "test_brake.py").write_text(TEST)
    from verifai_jax.core.user_code.targets import load_target

    problem = load_target("specs/brake.py:brake", vj.Problem)
    run = vj.falsify(problem, "uniform", 8, progress=False, folder="runs/brake-1")
    run.report("runs/brake-1/report.html", studies=False)
    vj.estimate(problem, "monte_carlo", 16, progress=False).report(
        "reports/rate.html", problem=problem
    )
    return tmp_path


@pytest.mark.slow
def test_a_whole_chain_and_every_change_of_it(project):
    whole = traced()
    assert whole.complete, str(whole)
    assert "2 requirements: every link is there, and fits" in str(whole)
    first, second = whole.rows
    assert (first.requirement, first.text) == ("REQ-1", "The gap stays positive.")
    assert first.tests == ("tests/test_brake.py::test_brake",)
    assert first.runs == second.runs == ("runs/brake-1",)
    assert first.claims == ("runs/brake-1/report.claims.json", "reports/rate.claims.json")
    assert first.reports == ("runs/brake-1/report.html", "reports/rate.html")
    page = whole.report("trace.html").read_text()
    assert "The gap stays positive." in page
    assert "reports/rate.html" in page
    assert "REQ-1" in (project / whole.to_csv("trace.csv")).read_text()
    shown = (project / "runs/brake-1/report.html").read_text()
    assert "The gap stays positive." in shown
    assert "ISO 15622, 6.2" in shown
    claims = json.loads((project / "reports/rate.claims.json").read_text())
    assert claims["about"]["requirements"]["REQ-1"]["links"] == "SYS-4 SYS-5"

    # A changed formula concerns its own requirement, although both stand in one file.
    write_spec(first="always gap > 0.1")
    changed = traced()
    assert {gap.subject for gap in changed.gaps} == {"REQ-1"}
    assert [gap.link for gap in changed.suspect] == ["runs", "claims", "claims"]
    assert "always (gap > 0) then, always (gap > 0.1) now" in changed.suspect[0].text

    # So does a changed demand.
    write_spec(text="The gap stays large.")
    changed = traced()
    assert {gap.subject for gap in changed.gaps} == {"REQ-1"}
    assert "the requirement has changed since runs/brake-1: its text" in str(changed)

    # A changed model concerns all that was simulated.
    write_spec(gap="3.0")
    changed = traced()
    assert {gap.subject for gap in changed.gaps} == {"REQ-1", "REQ-2"}
    assert len(changed.suspect) == 6
    assert not changed.missing
    assert "REQ-2: the model has changed since reports/rate.claims.json" in str(changed)

    # Comments and other text are no part of the model.
    write_spec()
    with open("specs/brake.py", "a") as file:
        file.write("# Written later.\n")
    assert traced().complete, str(traced())

    write_spec()
    # A run that goes on is another one than its report is about.
    from verifai_jax.core.user_code.targets import load_target

    vj.resume("runs/brake-1", load_target("specs/brake.py:brake", vj.Problem), budget=16,
              progress=False)  # fmt: skip
    changed = traced()
    assert [gap.link for gap in changed.suspect] == ["claims", "claims"]
    assert "the run has changed since runs/brake-1/report.claims.json" in str(changed)
    (project / "reports/rate.html").unlink()
    assert "the report of reports/rate.claims.json is not there" in str(traced())


@pytest.mark.slow
def test_the_command_is_a_gate(project):
    ask = lambda *more: CliRunner().invoke(main, ["trace", "specs/brake.py", *more])  # noqa: E731
    done = ask("--fail-on", "incomplete", "--report", "out/trace.html", "--json")
    assert done.exit_code == 0, done.output
    (project / "tests/test_brake.py").unlink()
    done = ask("--fail-on", "missing")
    assert done.exit_code == 1
    assert "nothing tests REQ-2 in problem 'brake'" in done.output
    assert ask("--fail-on", "suspect").exit_code == 0
    assert ask("--fail-on", "missing", "--without", "tests").exit_code == 0
    (project / "pyproject.toml").write_text('[tool.pytest.ini_options]\nvj_specs = ["specs/*.py"]')
    assert ask("--fail-on", "missing").exit_code == 0


def system(features, key):
    return vj.Trace({"x": features["a"] * jnp.ones(3)}, dt=0.1)


def problem_of(*names, name="some", **options):
    spec = dict.fromkeys(names, "always x < 2")
    return vj.Problem(name, {"a": vj.Box(0.0, 1.0)}, system, spec, **options)


def test_links_that_are_missing():
    demands = [Requirement("A", parse("always x < 3"), "a text"), Requirement("B")]
    problem = problem_of("A", "C", requirements=demands)

    @vj.test(problem_of("D", name="other"))
    def test_other(): ...

    found = vj.trace_matrix(problem, tests=[test_other], runs=[])
    assert found.asked == ("tests", "runs", "claims")
    assert [(gap.kind, gap.link, gap.subject) for gap in found.gaps] == [
        ("missing", "requirement", "test_other"),
        ("suspect", "formula", "A"),
        ("missing", "tests", "A"),
        ("missing", "runs", "A"),
        ("missing", "claims", "A"),
        ("missing", "requirement", "C"),
        ("missing", "tests", "C"),
        ("missing", "runs", "C"),
        ("missing", "claims", "C"),
        ("missing", "formula", "B"),
    ]
    assert list(found.table.requirement) == ["A", "B", ""]
    assert "10 links" not in str(found)
    assert "9 links are missing and 1 link is suspect" in str(found)
    assert vj.trace_matrix(problem_of("A", requirements=[Requirement("A")])).complete
    with pytest.raises(ValueError, match="two problems are called 'some'"):
        vj.trace_matrix([problem, problem])
    with pytest.raises(ValueError, match="two requirements 'A' differ"):
        vj.trace_matrix(problem, requirements=[Requirement("A"), Requirement("A", text="t")])


def test_claims_of_another_form_are_named(tmp_path):
    (tmp_path / "some.claims.json").write_text('{"about": {"result": 1}}')
    with pytest.raises(ValueError, match=r"some.claims.json holds no claims of a report"):
        vj.trace_matrix(problem_of("A"), reports=[tmp_path])


@pytest.mark.parametrize("ending", [".csv", ".reqif"])
def test_files_that_are_written_are_read_again(tmp_path, ending):
    demands = (
        Requirement("REQ-1", parse("always[0, 2] x < 1"), "Größer als <0> & \"kleiner\"", "m",
                    "§ 4", "why, so", "S3", ("SYS-1", "SYS-2")),
        Requirement("REQ-2", text="no formula yet"),
    )  # fmt: skip
    path = write_requirements(demands, tmp_path / f"some{ending}")
    assert read_requirements(path, need_formulas=False) == demands
    with pytest.raises(ValueError, match=r"requirement 2 of .* has no formula"):
        read_requirements(path)
    with pytest.raises(ValueError, match=r"to a .csv or a .reqif file; got some.txt"):
        write_requirements(demands, tmp_path / "some.txt")


REQIF = """<?xml version="1.0"?>
<REQ-IF xmlns="http://www.omg.org/spec/ReqIF/20110401/reqif.xsd" xmlns:x="http://www.w3.org/1999/xhtml">
<CORE-CONTENT><REQ-IF-CONTENT><DATATYPES>
<DATATYPE-DEFINITION-ENUMERATION IDENTIFIER="e"><SPECIFIED-VALUES>
<ENUM-VALUE IDENTIFIER="e1" LONG-NAME="ASIL B"/>
</SPECIFIED-VALUES></DATATYPE-DEFINITION-ENUMERATION>
</DATATYPES><SPEC-TYPES><SPEC-OBJECT-TYPE IDENTIFIER="t"><SPEC-ATTRIBUTES>
<ATTRIBUTE-DEFINITION-XHTML IDENTIFIER="a" LONG-NAME="ReqIF.Text"/>
<ATTRIBUTE-DEFINITION-STRING IDENTIFIER="b" LONG-NAME="ReqIF.ForeignID"/>
<ATTRIBUTE-DEFINITION-ENUMERATION IDENTIFIER="c" LONG-NAME="Severity"/>
<ATTRIBUTE-DEFINITION-STRING IDENTIFIER="d" LONG-NAME="Owner"/>
</SPEC-ATTRIBUTES></SPEC-OBJECT-TYPE></SPEC-TYPES><SPEC-OBJECTS>
<SPEC-OBJECT IDENTIFIER="o1"><VALUES>
<ATTRIBUTE-VALUE-XHTML><DEFINITION><ATTRIBUTE-DEFINITION-XHTML-REF>a</ATTRIBUTE-DEFINITION-XHTML-REF>
</DEFINITION><THE-VALUE><x:div>The <x:b>gap</x:b> stays
 large.</x:div></THE-VALUE></ATTRIBUTE-VALUE-XHTML>
<ATTRIBUTE-VALUE-STRING THE-VALUE="R-7"><DEFINITION><ATTRIBUTE-DEFINITION-STRING-REF>b
</ATTRIBUTE-DEFINITION-STRING-REF></DEFINITION></ATTRIBUTE-VALUE-STRING>
<ATTRIBUTE-VALUE-ENUMERATION><VALUES><ENUM-VALUE-REF>e1</ENUM-VALUE-REF></VALUES><DEFINITION>
<ATTRIBUTE-DEFINITION-ENUMERATION-REF>c</ATTRIBUTE-DEFINITION-ENUMERATION-REF></DEFINITION>
</ATTRIBUTE-VALUE-ENUMERATION>
<ATTRIBUTE-VALUE-STRING THE-VALUE="me"><DEFINITION><ATTRIBUTE-DEFINITION-STRING-REF>d
</ATTRIBUTE-DEFINITION-STRING-REF></DEFINITION></ATTRIBUTE-VALUE-STRING></VALUES></SPEC-OBJECT>
<SPEC-OBJECT IDENTIFIER="o2"><VALUES>
<ATTRIBUTE-VALUE-XHTML><DEFINITION><ATTRIBUTE-DEFINITION-XHTML-REF>a</ATTRIBUTE-DEFINITION-XHTML-REF>
</DEFINITION><THE-VALUE><x:div>Above.</x:div></THE-VALUE></ATTRIBUTE-VALUE-XHTML></VALUES></SPEC-OBJECT>
</SPEC-OBJECTS><SPEC-RELATIONS><SPEC-RELATION IDENTIFIER="r"><SOURCE><SPEC-OBJECT-REF>o1
</SPEC-OBJECT-REF></SOURCE><TARGET><SPEC-OBJECT-REF>o2</SPEC-OBJECT-REF></TARGET></SPEC-RELATION>
</SPEC-RELATIONS></REQ-IF-CONTENT></CORE-CONTENT></REQ-IF>"""


def test_reqif_of_other_tools(tmp_path):
    path = tmp_path / "tool.reqif"
    path.write_text(REQIF)
    first, second = read_requirements(path, need_formulas=False)
    assert (first.id, first.text) == ("R-7", "The gap stays large.")
    assert (first.severity, first.links) == ("ASIL B", ("o2",))
    assert (second.id, second.text) == ("o2", "Above.")


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (
            '<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><REQ-IF>&x;</REQ-IF>',
            "DOCTYPE a>",
        ),
        ('<!DOCTYPE REQ-IF SYSTEM "http://x/y.dtd"><REQ-IF/>', "which is refused"),
        ("<REQ-IF>&x;</REQ-IF>", "is not XML: undefined entity"),
        ("<other/>", "its first element is other, not REQ-IF"),
        ("<REQ-IF/>", "has no requirement"),
        ("", "is not XML"),
    ],
)
def test_xml_that_is_refused(tmp_path, text, match):
    path = tmp_path / "some.reqif"
    path.write_text(text)
    with pytest.raises(ValueError, match=re.escape(match)):
        read_requirements(path)


def test_yaml_runs_nothing(tmp_path):
    path = tmp_path / "some.yaml"
    path.write_text("requirements: !!python/object/apply:os.getcwd []")
    with pytest.raises(ValueError, match=r"some.yaml is not YAML"):
        read_requirements(path)
    path.write_text("- id: A")
    with pytest.raises(ValueError, match="must have a list `requirements`; got list"):
        read_requirements(path)
    path.write_text("requirements: [{id: A, formula: x < lim, severity: 3}]\nconstants: {lim: 2}")
    (found,) = read_requirements(path)
    assert (str(found.formula), found.severity) == ("x < 2", "3")
