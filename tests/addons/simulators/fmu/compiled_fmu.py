"""FMUs in C for FMI 2 and 3, compiled by the system's compiler.

A mass on a spring has a solver of its own; a bouncing ball is for model exchange, with events.
"""

import shutil
import subprocess
import zipfile

import pytest

VARIABLES = {
    # name: reference, causality, variability, start, range, unit
    "m": (0, "parameter", "fixed", "1.0", (0.5, 2.0), "kg"),
    "k": (1, "parameter", "tunable", "4.0", (1.0, 9.0), "N/m"),
    "x0": (2, "parameter", "fixed", "1.0", None, "m"),
    "force": (3, "input", "continuous", "0.0", None, "N"),
    "body.x": (4, "output", "continuous", None, None, "m"),
    "v": (5, "output", "continuous", None, None, "m/s"),
}

MODEL = r"""
#include <stdlib.h>
#include <string.h>
#include <stdint.h>
#include <stdbool.h>
typedef struct { double r[8]; int32_t mode; } Model;
static void reset(Model *m) {
  double start[] = {1, 4, 1, 0, 0, 0}; memcpy(m->r, start, sizeof start); m->mode = 0;
}
static int advance(Model *m, double h) {
  /* Crashes, hangs, ends and errors on purpose. */
  if (m->mode == 1) abort();
  if (m->mode == 2) return 3;
  if (m->mode == 3) return 2;
  int n = 100;
  for (int i = 0; i < n; i++) {
    m->r[5] += h / n * (m->r[3] - m->r[1] * m->r[4]) / m->r[0];
    m->r[4] += h / n * m->r[5];
  }
  return 0;
}
"""

TWO = r"""
typedef void (*Log)(void*, const char*, int, const char*, const char*, ...);
typedef struct { Log log; void *a, *f, *s, *e; } Calls;
typedef struct { Model m; Calls c; } C2;
void *fmi2Instantiate(const char *n, int t, const char *g, const char *r, Calls *c, int v, int l) {
  if (strcmp(g, "token")) return 0;
  C2 *x = calloc(1, sizeof(C2)); x->c = *c; reset(&x->m); return x; }
void fmi2FreeInstance(void *c) { free(c); }
int fmi2SetupExperiment(void *c, int a, double b, double d, int e, double f) { return 0; }
int fmi2EnterInitializationMode(void *c) { return 0; }
int fmi2ExitInitializationMode(C2 *c) { c->m.r[4] = c->m.r[2]; return 0; }
int fmi2Terminate(void *c) { return 0; }
int fmi2Reset(C2 *c) { reset(&c->m); return 0; }
int fmi2SetReal(C2 *c, const unsigned *v, size_t n, const double *x) {
  for (size_t i = 0; i < n; i++) c->m.r[v[i]] = x[i]; return 0; }
int fmi2GetReal(C2 *c, const unsigned *v, size_t n, double *x) {
  for (size_t i = 0; i < n; i++) x[i] = c->m.r[v[i]]; return 0; }
int fmi2SetInteger(C2 *c, const unsigned *v, size_t n, const int *x) { c->m.mode = x[0]; return 0; }
int fmi2DoStep(C2 *c, double t, double h, int p) {
  int s = advance(&c->m, h);
  if (s == 3) c->c.log(0, "spring", 3, "error", "the spring broke");
  return s; }
"""

ANY_THREE = r"""
void fmi3FreeInstance(void *c) { free(c); }
int fmi3EnterInitializationMode(void *c, bool a, double b, double d, bool e, double f) { return 0; }
int fmi3Terminate(void *c) { return 0; }
int fmi3Reset(Model *c) { reset(c); return 0; }
int fmi3SetFloat64(Model *c, const uint32_t *v, size_t n, const double *x, size_t m) {
  for (size_t i = 0; i < n; i++) c->r[v[i]] = x[i]; return 0; }
int fmi3GetFloat64(Model *c, const uint32_t *v, size_t n, double *x, size_t m) {
  for (size_t i = 0; i < n; i++) x[i] = c->r[v[i]]; return 0; }
int fmi3SetInt32(Model *c, const uint32_t *v, size_t n, const int32_t *x, size_t m) {
  c->mode = x[0]; return 0; }
"""
"""What all models have in FMI 3."""

THREE = (
    ANY_THREE
    + r"""
typedef void (*Log)(void*, int, const char*, const char*);
void *fmi3InstantiateCoSimulation(const char *n, const char *g, const char *r, bool v, bool l,
    bool e, bool a, const unsigned *q, size_t nq, void *env, Log log, void *u) {
  if (strcmp(g, "token")) return 0;
  Model *x = calloc(1, sizeof(Model)); reset(x); return x; }
int fmi3ExitInitializationMode(Model *c) { c->r[4] = c->r[2]; return 0; }
int fmi3DoStep(Model *c, double t, double h, bool p, bool *e, bool *end, bool *r, double *last) {
  int s = advance(c, h); *e = *r = false; *end = s == 2; return s == 2 ? 0 : s; }
"""
)


STATES_TWO = r"""
int fmi2GetFMUstate(C2 *c, C2 **s) { *s = malloc(sizeof(C2)); memcpy(*s, c, sizeof(C2)); return 0; }
int fmi2SetFMUstate(C2 *c, C2 *s) { memcpy(c, s, sizeof(C2)); return 0; }
"""
STATES_THREE = STATES_TWO.replace("fmi2", "fmi3").replace("FMUs", "FMUS").replace("C2", "Model")


def build_forgetful(folder, version, can=""):
    """Compile the spring with a reset that resets only its speed, and states that can be saved."""
    code, states = (TWO, STATES_TWO) if version == 2 else (THREE, STATES_THREE)
    call = "reset(&c->m);" if version == 2 else "reset(c);"
    code = code.replace(call, f"c->{'m.' if version == 2 else ''}r[5] = 0;")
    return build(folder, version, MODEL + code + states, description(version, can=can))


BALL_VARIABLES = {
    "g": (0, "parameter", "fixed", "9.81", None, "m/s2"),
    "e": (1, "parameter", "fixed", "0.7", None, "1"),
    "kick_at": (2, "parameter", "fixed", "100.0", None, "s"),
    "push": (3, "input", "continuous", "0.0", None, "m/s2"),
    "h": (4, "output", "continuous", "1.0", None, "m"),
    "v": (5, "output", "continuous", "0.0", None, "m/s"),
    "bounces": (6, "output", "discrete", None, None, "1"),
    "der(h)": (7, "local", "continuous", None, None, "m/s"),
    "der(v)": (8, "local", "continuous", None, None, "m/s2"),
    "asks_at": (9, "parameter", "fixed", "100.0", None, "m"),
}

BALL = r"""
typedef struct { double r[10]; int32_t mode; double time; int kicked; } Model;
static void reset(Model *m) {
  double start[] = {9.81, 0.7, 100, 0, 1, 0, 0, 0, 0, 100}; memcpy(m->r, start, sizeof start);
  m->mode = 0; m->time = 0; m->kicked = 0; }
/* A bounce at the ground, a kick at a time that is known, a catch where a step asks for it. */
static int event(Model *m, double *next) {
  if (m->r[4] <= 0 && m->r[5] < 0) { m->r[5] *= -m->r[1]; m->r[6]++; }
  if (m->time >= m->r[2] && !m->kicked) { m->r[5] += 2; m->kicked = 1; }
  if (m->r[5] > m->r[9]) m->r[5] = 0;
  *next = m->r[2];
  return m->mode == 1; }
static void slopes(Model *m, double *dx) {
  dx[0] = m->r[7] = m->r[5]; dx[1] = m->r[8] = m->r[3] - m->r[0]; }
static int asks(Model *m) { return m->r[5] > m->r[9]; }
static int ends(Model *m) { return m->mode == 2 && m->r[4] < 0.5; }
"""

BALL_TWO = r"""
typedef struct { int again, end, nominals, states, timed; double next; } Info;
void *fmi2Instantiate(const char *n, int t, const char *g, const char *r, void *c, int v, int l) {
  if (strcmp(g, "token") || t != 0) return 0;
  Model *x = calloc(1, sizeof(Model)); reset(x); return x; }
void fmi2FreeInstance(void *c) { free(c); }
int fmi2SetupExperiment(void *c, int a, double b, double d, int e, double f) { return 0; }
int fmi2EnterInitializationMode(void *c) { return 0; }
int fmi2ExitInitializationMode(void *c) { return 0; }
int fmi2Terminate(void *c) { return 0; }
int fmi2Reset(Model *c) { reset(c); return 0; }
int fmi2SetReal(Model *c, const unsigned *v, size_t n, const double *x) {
  for (size_t i = 0; i < n; i++) c->r[v[i]] = x[i]; return 0; }
int fmi2GetReal(Model *c, const unsigned *v, size_t n, double *x) {
  for (size_t i = 0; i < n; i++) x[i] = c->r[v[i]]; return 0; }
int fmi2SetInteger(Model *c, const unsigned *v, size_t n, const int *x) { c->mode = *x; return 0; }
int fmi2EnterEventMode(void *c) { return 0; }
int fmi2EnterContinuousTimeMode(void *c) { return 0; }
int fmi2NewDiscreteStates(Model *c, Info *i) {
  memset(i, 0, sizeof *i); i->again = event(c, &i->next); i->timed = !c->kicked; return 0; }
int fmi2SetTime(Model *c, double t) { c->time = t; return 0; }
int fmi2SetContinuousStates(Model *c, const double *x, size_t n) {
  memcpy(c->r + 4, x, 16); return 0; }
int fmi2GetContinuousStates(Model *c, double *x, size_t n) { memcpy(x, c->r + 4, 16); return 0; }
int fmi2GetNominalsOfContinuousStates(Model *c, double *x, size_t n) { x[0] = x[1] = 1; return 0; }
int fmi2GetDerivatives(Model *c, double *dx, size_t n) { slopes(c, dx); return 0; }
int fmi2GetEventIndicators(Model *c, double *z, size_t n) { z[0] = c->r[4]; return 0; }
int fmi2CompletedIntegratorStep(Model *c, int no, int *enter, int *end) {
  *enter = asks(c); *end = ends(c); return 0; }
"""

BALL_THREE = (
    ANY_THREE
    + r"""
void *fmi3InstantiateModelExchange(const char *n, const char *g, const char *r, bool v, bool l,
    void *env, void *log) {
  if (strcmp(g, "token")) return 0;
  Model *x = calloc(1, sizeof(Model)); reset(x); return x; }
int fmi3ExitInitializationMode(void *c) { return 0; }
int fmi3EnterEventMode(void *c) { return 0; }
int fmi3EnterContinuousTimeMode(void *c) { return 0; }
int fmi3UpdateDiscreteStates(Model *c, bool *again, bool *end, bool *n, bool *x, bool *timed,
    double *next) {
  *end = *n = *x = false; *again = event(c, next); *timed = !c->kicked; return 0; }
int fmi3SetTime(Model *c, double t) { c->time = t; return 0; }
int fmi3SetContinuousStates(Model *c, const double *x, size_t n) {
  memcpy(c->r + 4, x, 16); return 0; }
int fmi3GetContinuousStates(Model *c, double *x, size_t n) { memcpy(x, c->r + 4, 16); return 0; }
int fmi3GetNominalsOfContinuousStates(Model *c, double *x, size_t n) { x[0] = x[1] = 1; return 0; }
int fmi3GetNumberOfContinuousStates(Model *c, size_t *n) { *n = 2; return 0; }
int fmi3GetNumberOfEventIndicators(Model *c, size_t *n) { *n = 1; return 0; }
int fmi3GetContinuousStateDerivatives(Model *c, double *dx, size_t n) { slopes(c, dx); return 0; }
int fmi3GetEventIndicators(Model *c, double *z, size_t n) { z[0] = c->r[4]; return 0; }
int fmi3CompletedIntegratorStep(Model *c, bool no, bool *enter, bool *end) {
  *enter = asks(c); *end = ends(c); return 0; }
"""
)

TEXT = 'name="text" valueReference="21" causality="output" variability="discrete"'
INCLUDES = "\n".join(MODEL.splitlines()[1:5]) + "\n"
STRUCTURE = (
    "<ModelStructure><Derivatives><Unknown index='8'/><Unknown index='9'/></Derivatives>"
    "</ModelStructure>"
)


def description(
    version, doctype="", variables=VARIABLES, kind="CoSimulation", more_of_root="", can=""
):
    real = "Real" if version == 2 else "Float64"
    rows = []
    for name, (reference, causality, variability, start, ends, unit) in variables.items():
        more = "" if start is None else f' start="{start}"'
        if ends:
            more += f' declaredType="T{name}"'
        common = f'name="{name}" valueReference="{reference}" causality="{causality}"'
        common += f' variability="{variability}"'
        more += f' unit="{unit}"'
        if version == 2:
            rows.append(f"<ScalarVariable {common}><{real}{more}/></ScalarVariable>")
        else:
            rows.append(f"<{real} {common}{more}/>")
    common = 'name="mode" valueReference="20" causality="parameter" variability="fixed"'
    if version == 2:
        rows.append(f'<ScalarVariable {common}><Integer start="0"/></ScalarVariable>')
        rows.append(f"<ScalarVariable {TEXT}><String/></ScalarVariable>")
    else:
        rows.append(f'<Int32 {common} start="0"/>')
        rows.append(f"<String {TEXT}/>")
        rows.append(
            '<Float64 name="table" valueReference="9" causality="parameter" start="0 0">'
            '<Dimension start="2"/></Float64>'
        )
    kinds = []
    for name, (*_, ends, _) in variables.items():
        if ends:
            span = f'min="{ends[0]}" max="{ends[1]}"'
            kinds.append(
                f'<SimpleType name="T{name}"><Real {span}/></SimpleType>'
                if version == 2
                else f'<Float64Type name="T{name}" {span}/>'
            )
    token = 'guid="token"' if version == 2 else 'instantiationToken="token"'
    return (
        f'<?xml version="1.0"?>{doctype}<fmiModelDescription fmiVersion="{version}.0" '
        f'modelName="spring" {token} numberOfEventIndicators="1">'
        f'<{kind} modelIdentifier="spring" {can}/>'
        f"<TypeDefinitions>{''.join(kinds)}</TypeDefinitions>"
        f"<ModelVariables>{''.join(rows)}</ModelVariables>{more_of_root}</fmiModelDescription>"
    )


def build_ball(folder, version):
    """Compile the FMU for model exchange, and return its file."""
    code = INCLUDES + BALL + (BALL_TWO if version == 2 else BALL_THREE)
    asks = 'needsCompletedIntegratorStep="true"'
    text = description(version, "", BALL_VARIABLES, "ModelExchange", STRUCTURE, asks)
    return build(folder, version, code, text)


def build(folder, version, code=None, text=None):
    """Compile an FMU, that of the spring when nothing else is given, and return its file."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("there is no C compiler")
    source, binary = folder / "spring.c", folder / "spring.so"
    source.write_text(code or MODEL + (TWO if version == 2 else THREE))
    subprocess.run([compiler, "-O1", "-w", "-shared", "-fPIC", source, "-o", binary], check=True)
    file = folder / f"spring{version}.fmu"
    place = "linux64" if version == 2 else "x86_64-linux"
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("modelDescription.xml", text or description(version))
        archive.write(binary, f"binaries/{place}/spring.so")
    return file
