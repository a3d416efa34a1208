"""Enumerations, whole numbers, booleans and stop times of FMUs, as the FMU declares them."""

import sys

import numpy as np
import pytest

import verifai_jax as vj
from tests.addons.simulators.fmu.compiled_fmu import INCLUDES, build

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="binaries of Linux are compiled")
OUTPUTS = ("quality", "gear", "lamp", "level", "ended")
# A step beyond the stop time is an error, as in FMUs that compare to the bit.
COMMON = r"""
typedef struct { double r[4]; int64_t i[8]; double stop; } Model;
static void reset(Model *m) { memset(m, 0, sizeof *m); m->i[0] = m->i[1] = 1; }
static int advance(Model *m, double t, double h) {
  m->r[1] = t + h; return t + h > m->stop ? 3 : 0; }
#define PAIR(PRE, KIND, C, ARRAY, MORE) \
  int PRE##Set##KIND(Model *m, const uint32_t *v, size_t n, const C *x MORE) { \
    for (size_t k = 0; k < n; k++) m->ARRAY[v[k]] = x[k]; return 0; } \
  int PRE##Get##KIND(Model *m, const uint32_t *v, size_t n, C *x MORE) { \
    for (size_t k = 0; k < n; k++) x[k] = m->ARRAY[v[k]]; return 0; }
#define NONE
#define SIZE , size_t q
"""
TWO = r"""
void *fmi2Instantiate(const char *n, int t, const char *g, const char *r, void *c, int v, int l) {
  Model *x = calloc(1, sizeof(Model)); reset(x); return x; }
void fmi2FreeInstance(void *c) { free(c); }
int fmi2SetupExperiment(Model *m, int a, double b, double d, int e, double f) {
  m->stop = f; return 0; }
int fmi2EnterInitializationMode(void *c) { return 0; }
int fmi2ExitInitializationMode(void *c) { return 0; }
int fmi2Terminate(void *c) { return 0; }
int fmi2Reset(Model *c) { reset(c); return 0; }
PAIR(fmi2, Real, double, r, NONE)
PAIR(fmi2, Integer, int, i, NONE) PAIR(fmi2, Boolean, int, i, NONE)
int fmi2DoStep(Model *c, double t, double h, int p) { return advance(c, t, h); }
"""
THREE = r"""
void *fmi3InstantiateCoSimulation(const char *n, const char *g, const char *r, bool v, bool l,
    bool e, bool a, const unsigned *q, size_t nq, void *env, void *log, void *u) {
  Model *x = calloc(1, sizeof(Model)); reset(x); return x; }
void fmi3FreeInstance(void *c) { free(c); }
int fmi3EnterInitializationMode(Model *m, bool a, double b, double d, bool e, double f) {
  m->stop = f; return 0; }
int fmi3ExitInitializationMode(void *c) { return 0; }
int fmi3Terminate(void *c) { return 0; }
int fmi3Reset(Model *c) { reset(c); return 0; }
PAIR(fmi3, Float64, double, r, SIZE) PAIR(fmi3, UInt8, uint8_t, i, SIZE)
PAIR(fmi3, Int64, int64_t, i, SIZE) PAIR(fmi3, Boolean, bool, i, SIZE)
int fmi3DoStep(Model *c, double t, double h, bool p, bool *e, bool *end, bool *r, double *last) {
  *e = *end = *r = false; return advance(c, t, h); }
"""


def described(version, varies):
    items = '<Item name="good" value="1"/><Item name="bad" value="2"/>'
    two = version == 2
    kinds = (
        f'<SimpleType name="Q"><Enumeration>{items}</Enumeration></SimpleType>'
        if two
        else f'<EnumerationType name="Q">{items}</EnumerationType>'
    )
    rows = [
        ("quality", 0, "Enumeration", 'declaredType="Q" start="1"'),
        ("gear", 1, "Integer" if two else "UInt8", 'start="1" min="1" max="5"'),
        ("lamp", 2, "Boolean", 'start="false"'),
        ("level", 0, "Real" if two else "Float64", 'start="0" min="0" max="1" unit="m"'),
        ("ended", 1, "Real" if two else "Float64", 'start="0"'),
    ]
    rows = [
        f'<ScalarVariable name="{n}" valueReference="{r}" causality="parameter" '
        f'variability="tunable"><{t} {more}/></ScalarVariable>'
        if two
        else f'<{t} name="{n}" valueReference="{r}" causality="parameter" variability="tunable" '
        f"{more}/>"
        for n, r, t, more in rows
    ]
    if not two:
        rows.append(
            '<Float64 name="table" valueReference="3" causality="parameter" variability="fixed" '
            'start="0 0"><Dimension start="2"/></Float64>'
        )
    token = 'guid="t"' if two else 'instantiationToken="t"'
    can = f'canHandleVariableCommunicationStepSize="{"true" if varies else "false"}"'
    return (
        f'<fmiModelDescription fmiVersion="{version}.0" modelName="s" {token}>'
        f'<CoSimulation modelIdentifier="spring" {can}/><TypeDefinitions>{kinds}</TypeDefinitions>'
        f"<ModelVariables>{''.join(rows)}</ModelVariables></fmiModelDescription>"
    )


@pytest.fixture(scope="module", params=[2, 3])
def files(request, tmp_path_factory):
    code = INCLUDES + COMMON + (TWO if request.param == 2 else THREE)
    made = [tmp_path_factory.mktemp("fmu") for _ in range(2)]
    return [
        build(folder, request.param, code, described(request.param, varies))
        for folder, varies in zip(made, (False, True), strict=True)
    ]


@pytest.fixture
def system(files):
    return vj.fmu(files[0], duration=0.2, dt=0.1, outputs=OUTPUTS, workers=None)


def problem(system, **space):
    return vj.Problem("valve", space, system, "always level < 2")


def last(trace, *names):
    return [float(trace.signals[name][-1]) for name in names]


@pytest.mark.thorough
def test_an_item_is_sent_by_its_value(system):
    space = {"quality": vj.Categorical("bad", "good"), "lamp": vj.Categorical(False, True)}
    space |= {"gear": vj.DiscreteBox(1, 5)}
    valve = problem(system, **space)
    valve.check()
    assert valve.system.notes == ()
    run = vj.simulate(valve, [{"quality": q, "lamp": True, "gear": 4} for q in ("good", "bad")])
    for row, value in enumerate((1.0, 2.0)):
        assert last(run.replay(row).trace, "quality", "gear", "lamp") == [value, 4.0, 1.0]
    # Held at one value, and in a call of the system alone.
    fixed = valve.only("gear", nominal={"quality": "bad", "lamp": False, "gear": 2})
    fixed.check()
    assert last(vj.simulate(fixed, [{"gear": 2}]).replay(0).trace, "quality") == [2.0]
    assert last(system({"quality": "good", "gear": 3}), "quality", "gear") == [1.0, 3.0]


@pytest.mark.parametrize(
    ("space", "message"),
    [
        ({"quality": vj.Categorical("good", "bed")}, "no item 'bed'.*'bad'"),
        ({"quality": vj.Categorical(0, 1)}, r"1 \(good\), 2 \(bad\); got 0"),
        ({"quality": vj.DiscreteBox(1, 3)}, r"1 \(good\), 2 \(bad\); got 3"),
        ({"gear": vj.Box(1.0, 5.0)}, "sets gear .*by real values: give whole ones"),
        ({"gear": vj.Normal(1.0, 0.2)}, "sets gear .*by real values"),
        ({"gear": vj.Categorical(1.5, 2.0)}, "a whole number; got 1.5"),
        ({"gear": vj.Signal(vj.Box(1, 5), knots=3)}, "sets gear .*by real values"),
        ({"lamp": vj.Box(0.0, 1.0)}, "sets lamp .*by real values"),
        ({"lamp": vj.DiscreteBox(0, 2)}, "0 or 1; got 2"),
        ({"level": vj.Categorical("low", "high")}, "no item 'low'"),
        ({"level": vj.Array(vj.Box(0, 1), length=2)}, "is one number; the feature has"),
    ],
)  # fmt: skip
def test_values_that_a_variable_cannot_have_are_refused_before_a_run(system, space, message):
    with pytest.raises(ValueError, match=message):
        problem(system, **space).check()


def test_numbers_are_never_rounded_and_never_wrap(system):
    for wrong, message in (({"gear": 2.5}, "a whole number; got 2.5"), ({"lamp": 2}, "0 or 1")):
        with pytest.raises(ValueError, match=message):
            system(wrong)
    with pytest.raises(ValueError, match=r"gear is of type U?Int"):
        system({"gear": 2**40})


def test_an_array_is_refused(system):
    if system.simulation.function.description.version == 3:
        with pytest.raises(ValueError, match=r"table of the FMU .* is an array, not one number"):
            problem(system, table=vj.Box(0, 1)).check()


@pytest.mark.slow
def test_values_beyond_the_declared_range_are_a_note(system):
    beyond = problem(system, level=vj.Box(-1.0, 0.5), gear=vj.Categorical(2, 7))
    beyond.check()
    note = "from -1 to 0.5; the FMU declares level from 0 to 1"
    assert note in beyond.system.notes[0]
    assert "gear from 1 to 5" in beyond.system.notes[1]
    assert any(note in said for said in vj.falsify(beyond, budget=4, progress=False).notes)


@pytest.mark.parametrize("varies", [False, True])
def test_the_last_step_ends_at_the_stop_time(files, varies):
    for dt, steps in ((0.05, 200), (0.1, 25), (0.1, 3), (0.3, 7), (1 / 3, 9), (0.07, 11)):
        duration = round(dt * steps, 9)
        make = vj.fmu(files[varies], duration=duration, dt=dt, outputs=OUTPUTS, workers=None)
        trace = make({})
        assert trace.valid is None
        end = float(np.asarray(trace.signals["ended"], np.float64)[-1])
        assert end == duration if varies else abs(end - duration) < 1e-8


def test_a_duration_that_is_no_multiple_of_the_step(files):
    nearest = r"nearest are duration=0.9 or duration=1.2, or dt=0.25 or dt=0.333333"
    with pytest.raises(ValueError, match=nearest):
        vj.fmu(files[0], duration=1.0, dt=0.3, outputs=OUTPUTS)
    with pytest.raises(ValueError, match=r"multiple of dt; .*nearest are duration=0.3, or dt=0.1"):
        vj.fmu(files[0], duration=0.1, dt=0.3, outputs=OUTPUTS)
