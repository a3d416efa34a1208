"""What `verifai-jax doctor` says of an installation."""

import re
from pathlib import Path

from click.testing import CliRunner

from verifai_jax.addons.assurance.commands import doctor
from verifai_jax.addons.assurance.commands.doctor import TESTED, bad_pairs
from verifai_jax.cli.main import main

ROOT = Path(__file__).parents[3]


def test_doctor_knows_what_does_not_go_together():
    assert bad_pairs({"brax": "0.14.2", "mujoco": "3.4.0", "jax": "0.10.2"}) == []
    (pair,) = bad_pairs({"brax": "0.14.2", "mujoco": "4.0.1", "gymnax": None, "jax": "0.10.2"})
    assert pair.startswith("brax 0.14.2 with mujoco 4.0.1: its swimmer")
    (pair,) = bad_pairs({"gymnax": "0.0.9", "jax": "0.10.2"})
    assert "pip install 'gymnax>=1.0.1'" in pair
    (pair,) = bad_pairs({"gymnax": "1.0.1", "jax": "0.12.0.1"})
    assert "pip install 'jax<0.12'" in pair


def test_doctor_knows_the_defect_of_one_package():
    (defect,) = bad_pairs({"mujoco": "4.0.0", "jax": "0.12.0.1"})
    assert defect.startswith("mujoco 4.0.0: with a sparse constraint Jacobian the Newton solver")
    assert "verdicts of native simulations may be wrong" in defect
    assert bad_pairs({"mujoco": "4.0.1", "jax": "0.12.0.1"}) == []
    assert bad_pairs({"mujoco": "3.17.0", "jax": "0.12.0.1"}) == []


def test_doctor_checks_the_installation():
    output = CliRunner().invoke(main, ["doctor"]).output
    assert "jax " in output
    assert "devices" in output
    assert "cores" in output
    assert "tested      Python 3.11, jax 0.10.2, numpy 2.4.6 on Linux x86_64\n" in output


def test_doctor_says_that_versions_have_not_been_tested(monkeypatch):
    monkeypatch.setattr(doctor, "TESTED", (TESTED[0]._replace(jax="0.4.1"),))
    assert "has not been tested as a whole" in doctor.report()


def test_what_doctor_calls_tested_is_what_the_constraints_and_the_classifiers_say():
    pins = (ROOT / "constraints.txt").read_text()
    project = (ROOT / "pyproject.toml").read_text()
    classified = re.findall(r"Python :: (3\.\d+)", project)
    assert [each.python for each in TESTED] == classified
    assert f'requires-python = ">={TESTED[0].python}"' in project
    for each, comparison in zip(TESTED, ("<", ">="), strict=True):
        for package, version in (("jax", each.jax), ("jaxlib", each.jax), ("numpy", each.numpy)):
            assert f"{package}=={version} ; python_version {comparison} '3.12'\n" in pins
        assert each.platform.startswith("Linux")
    assert re.findall(r"Operating System :: (.*)\"", project) == ["POSIX :: Linux"]
