"""FMUs of FMI 2 and 3: results, controllers, inputs over time, crashes, refusals."""

import sys
import zipfile

import numpy as np
import pytest

import verifai_jax as vj
from tests.addons.simulators.fmu.compiled_fmu import build, build_forgetful, description

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="binaries of Linux are compiled")
TIMES = {"duration": 2.0, "dt": 0.05}


@pytest.fixture(scope="module", params=[2, 3])
def file(request, tmp_path_factory):
    return build(tmp_path_factory.mktemp("fmu"), request.param)


def exact(m, k, x0, times):
    return x0 * np.cos(np.sqrt(k / m) * times)


def push_back(time, outputs, features):
    return {"force": -3.0 * outputs["v"] * features["gain"]}


class TestSimulation:
    def test_parameters_and_start_values(self, file):
        system = vj.fmu(file, **TIMES, workers=None)
        trace = system({"m": 2.0, "k": 9.0, "x0": 0.5})
        clock = np.asarray(trace.clock())
        assert set(trace.signals) == {"body_x", "v"}
        np.testing.assert_allclose(trace.signals["body_x"], exact(2, 9, 0.5, clock), atol=3e-3)
        # The instance is used again, and forgets the values before.
        np.testing.assert_allclose(system({}).signals["body_x"], exact(1, 4, 1, clock), atol=3e-3)

    def test_an_input_over_time(self, file):
        space = vj.FeatureSpace({"force": vj.Signal(vj.Box(-1.0, 1.0), knots=3)})
        system = vj.fmu(file, **TIMES, outputs={"x": "body.x"}, bind={}, workers=None)
        still, pushed = (
            system(space.coerce({"force": knots})).signals["x"] for knots in ([0.0] * 3, [1.0] * 3)
        )
        # A constant force of 1 N moves the middle by 1/k.
        clock = np.arange(41) * 0.05
        np.testing.assert_allclose(pushed - still, 0.25 * (1 - np.cos(2 * clock)), atol=5e-3)

    def test_a_controller_sees_outputs_and_features(self, file):
        system = vj.fmu(file, **TIMES, controller=push_back, workers=None)
        swings = [np.abs(system({"gain": gain}).signals["v"][20:]).max() for gain in (0.0, 1.0)]
        assert swings[1] < 0.5 * swings[0]

    def test_an_early_end_keeps_the_samples_before_it(self, file):
        trace = vj.fmu(file, **TIMES, workers=None)({"mode": 3})
        assert int(trace.valid) == 1


@pytest.mark.slow
def test_a_crash_is_one_row(file):
    space = {"mode": vj.Categorical(0, 1, 2), "x0": vj.Box(0.5, 1.5)}
    problem = vj.Problem("spring", space, vj.fmu(file, **TIMES), "always body_x < 1.4")
    problem.check()
    rows = [{"mode": mode, "x0": x0} for mode, x0 in ((0, 1.0), (1, 1.0), (2, 1.0), (0, 1.45))]
    table = vj.simulate(problem, rows).table.all
    assert table["rho"].isna().tolist() == [
        False, True, True, False,
    ]  # fmt: skip
    assert [*table["violated"]] == [False, False, False, True]
    assert "SIGABRT" in table["message"][1]
    assert "DoStep of spring" in table["message"][2]
    if file.name == "spring2.fmu":
        assert "the spring broke" in table["message"][2]


@pytest.mark.parametrize("version", [2, 3])
class TestForgetfulReset:
    def test_a_saved_state_is_as_good_as_a_new_instance(self, version, tmp_path):
        can = f'canGetAndSetFMU{"state" if version == 2 else "State"}="true"'
        can += ' canBeInstantiatedOnlyOncePerProcess="true"'
        file = build_forgetful(tmp_path, version, can)
        system = vj.fmu(file, **TIMES, workers=None)
        first = system({})
        assert int(system({"m": 2.0, "x0": 3.0, "mode": 3}).valid) == 1
        with pytest.raises(RuntimeError, match="DoStep of spring"):
            system({"k": 2.0, "mode": 2})
        again = system({})
        assert again.valid is None
        for name, values in first.signals.items():
            np.testing.assert_array_equal(again.signals[name], values)
        with pytest.raises(ValueError, match="one instance of the FMU"):
            vj.fmu(file, **TIMES, reuse=False)

    def test_without_states(self, version, tmp_path):
        file = build_forgetful(tmp_path, version)
        system = vj.fmu(file, **TIMES, workers=None)
        # After an early end there is a new instance.
        assert int(system({"m": 2.0, "mode": 3}).valid) == 1
        first = system({}).signals["body_x"]
        assert np.any(system({"m": 2.0}).signals["body_x"] != first)
        assert np.any(system({}).signals["body_x"] != first)
        fresh = vj.fmu(file, **TIMES, workers=None, reuse=False)
        fresh({"m": 2.0})
        np.testing.assert_array_equal(fresh({}).signals["body_x"], first)


class TestDescription:
    def test_units_and_ranges(self, file):
        table = vj.fmu_variables(file)
        assert table.loc["k", ["unit", "low", "high", "causality"]].tolist() == [
            "N/m", 1.0, 9.0, "parameter",
        ]  # fmt: skip
        assert vj.fmu_ranges(file, ["m", "k"]) == {"m": (0.5, 2.0), "k": (1.0, 9.0)}
        assert vj.fmu_ranges(file, ["x0"], around=0.2) == {"x0": (0.8, 1.2)}
        with pytest.raises(ValueError, match=r"x0 of the FMU .* declares no finite range"):
            vj.fmu_ranges(file, ["x0"])

    def test_what_is_missing_is_named(self, file):
        system = vj.fmu(file, **TIMES)
        problem = vj.Problem("spring", {"mass": vj.Box(1, 2)}, system, "body_x < 2")
        with pytest.raises(ValueError, match="parameter, start value or input 'mass'"):
            problem.check()
        problem = vj.Problem("spring", {"m": vj.Box(1, 2)}, system, "position < 2")
        with pytest.raises(ValueError, match="signal 'position'"):
            problem.check()
        with pytest.raises(ValueError, match=r"variable 'body\.y'"):
            vj.fmu(file, **TIMES, outputs=["body.y"])

    def test_refusals(self, tmp_path):
        def made(text, binary=""):
            path = tmp_path / "made.fmu"
            with zipfile.ZipFile(path, "w") as archive:
                archive.writestr("modelDescription.xml", text)
                if binary:
                    archive.writestr(binary, "")
            return path

        bomb = '<!DOCTYPE x [<!ENTITY a "b">]>'
        with pytest.raises(ValueError, match="declares a document type"):
            vj.fmu(made(description(2, doctype=bomb)), **TIMES)
        utf16 = description(2, doctype=bomb).replace("?>", ' encoding="utf-16"?>', 1)
        with pytest.raises(ValueError, match="declares a document type"):
            vj.fmu(made(utf16.encode("utf-16")), **TIMES)
        with pytest.raises(ValueError, match=r"no binary for this machine .*; it has win64"):
            vj.fmu(made(description(2), "binaries/win64/spring.dll"), **TIMES)
        other = description(2).replace("CoSimulation", "ScheduledExecution")
        with pytest.raises(ValueError, match="not offer co-simulation or model exchange; it has n"):
            vj.fmu(made(other), **TIMES)
        with pytest.raises(ValueError, match="not offer ModelExchange; it has CoSimulation"):
            vj.fmu(made(description(2)), **TIMES, exchange=True)
        (tmp_path / "text.fmu").write_text("x")
        with pytest.raises(ValueError, match="not an FMU: an archive"):
            vj.fmu(tmp_path / "text.fmu", **TIMES)
        with pytest.raises(FileNotFoundError, match=r"no FMU .*absent\.fmu"):
            vj.fmu(tmp_path / "absent.fmu", **TIMES)
