"""Monitors as FMUs of FMI 2 for co-simulation, for Simulink and other tools: `export_fmu`."""

import contextlib
import hashlib
import re
import sys
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

from verifai_jax.addons.monitoring.c_monitor import export_c
from verifai_jax.addons.monitoring.margins import margins
from verifai_jax.addons.monitoring.quantities import completed
from verifai_jax.addons.monitoring.watching import FLAGS
from verifai_jax.addons.native.native_code.machine_code import Unavailable, compile_library
from verifai_jax.core.messages.checks import check_name
from verifai_jax.core.messages.text import counted
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.semantics import Semantics, hard
from verifai_jax.mtl.streams import streams

KINDS = ("", "_low", "_high")
"""Outputs of each formula: what `watch` returns of a step, and the ends of its interval."""
WRAPPER = r"""
#include <stdlib.h>
#include <string.h>
#ifdef _WIN32
#define VJ_EXPORT __declspec(dllexport)
#else
#define VJ_EXPORT __attribute__((visibility("default")))
#endif
#ifdef __cplusplus
extern "C" {
#endif
enum { COLUMNS = @columns, OUTPUTS = @outputs };
typedef void (*vj_logger)(void *, const char *, int, const char *, const char *, ...);
typedef struct {
  monitor m, scratch;
  double x[COLUMNS];
  vj_logger log;
  void *environment;
} vj_instance;

static int vj_failed(vj_instance *c, const char *message)
{
  if (c->log) { c->log(c->environment, "monitor", 3, "error", message); }
  return 3;
}

VJ_EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
VJ_EXPORT const char *fmi2GetVersion(void) { return "2.0"; }
VJ_EXPORT void *fmi2Instantiate(const char *name, int type, const char *guid, const char *folder,
  void *const *callbacks, int visible, int logs)
{
  (void)name; (void)folder; (void)visible; (void)logs;
  if (type != 1 || strcmp(guid, "@guid")) { return NULL; }
  vj_instance *c = (vj_instance *)calloc(1, sizeof(vj_instance));
  if (c && callbacks) {
    memcpy(&c->log, callbacks, sizeof c->log);
    c->environment = callbacks[4];
  }
  if (c) { monitor_start(&c->m); }
  return c;
}
VJ_EXPORT void fmi2FreeInstance(void *c) { free(c); }
VJ_EXPORT int fmi2Reset(vj_instance *c)
{
  memset(c->x, 0, sizeof c->x);
  monitor_start(&c->m);
  return 0;
}
VJ_EXPORT int fmi2SetReal(vj_instance *c, const unsigned *r, size_t n, const double *values)
{
  for (size_t i = 0; i < n; i++) {
    if (r[i] >= COLUMNS) { return vj_failed(c, "only the signals of the formula can be set"); }
    c->x[r[i]] = values[i];
  }
  return 0;
}
VJ_EXPORT int fmi2GetReal(vj_instance *c, const unsigned *r, size_t n, double *values)
{
  double ends[2][OUTPUTS];
  bool known = false;
  for (size_t i = 0; i < n; i++) {
    const unsigned k = r[i] - COLUMNS;
    if (r[i] < COLUMNS) { values[i] = c->x[r[i]]; continue; }
    if (k >= 3 * OUTPUTS) { return vj_failed(c, "there is no such variable"); }
    if ((k % 3) && !known) {
      monitor_interval(&c->m, &c->scratch, ends[0], ends[1]);
      known = true;
    }
    values[i] = (k % 3) ? ends[k % 3 - 1][k / 3] : c->m.out[k / 3];
  }
  return 0;
}
VJ_EXPORT int fmi2DoStep(vj_instance *c, double time, double size, int kept)
{
  (void)time; (void)kept;
  const double steps = floor(size / @dt + 0.5);
  if (!(steps >= 1.0) || fabs(size - steps * @dt) > 1e-6 * size) {
    return vj_failed(c, "the step of communication must be a multiple of @dt s");
  }
  for (double i = 0.0; i < steps; i++) { monitor_step(&c->m, c->x); }
  return 0;
}
VJ_EXPORT int fmi2GetFMUstate(vj_instance *c, vj_instance **state)
{
  if (!*state) { *state = (vj_instance *)malloc(sizeof *c); }
  if (!*state) { return 3; }
  **state = *c;
  return 0;
}
VJ_EXPORT int fmi2SetFMUstate(vj_instance *c, const vj_instance *state)
{
  c->m = state->m;
  memcpy(c->x, state->x, sizeof c->x);
  return 0;
}
VJ_EXPORT int fmi2FreeFMUstate(void *c, vj_instance **state)
{
  (void)c;
  free(*state);
  *state = NULL;
  return 0;
}
"""
NOTHING = (
    "SetDebugLogging, int on, size_t n, const char *const *categories",
    "SetupExperiment, int a, double tolerance, double start, int b, double stop",
    "EnterInitializationMode", "ExitInitializationMode", "Terminate",
)  # fmt: skip
"""Functions without effect, with their parameters."""
_MANY = "const unsigned *r, size_t n"
REFUSED = (
    *(f"{verb}{kind}, {_MANY}, {'const ' * (verb == 'Set')}{c} *values"
      for kind, c in (("Integer", "int"), ("Boolean", "int"), ("String", "char *"))
      for verb in ("Get", "Set")),
    "SerializedFMUstateSize, void *state, size_t *size",
    "SerializeFMUstate, void *state, char *bytes, size_t size",
    "DeSerializeFMUstate, const char *bytes, size_t size, void **state",
    f"GetDirectionalDerivative, {_MANY}, const unsigned *k, size_t m, const double *d, double *to",
    f"SetRealInputDerivatives, {_MANY}, const int *order, const double *values",
    f"GetRealOutputDerivatives, {_MANY}, const int *order, double *values",
    "CancelStep",
    *(f"Get{kind}Status, int kind, {c} *value" for kind, c in (
        ("", "int"), ("Real", "double"), ("Integer", "int"), ("Boolean", "int"),
        ("String", "const char *"))),
)  # fmt: skip
"""Functions of the standard that a monitor does not need; importers look for all of them."""


def export_fmu(
    formulas: Formula | str | Mapping[str, Formula | str], dt: float, file: str | Path, *,
    semantics: Semantics = hard, every: bool = False, sizes: Mapping[str, int] | None = None,
    units: Mapping[str, str] | None = None,
) -> Path:  # fmt: skip
    """Write a monitor as an FMU of FMI 2 for co-simulation, with its source in C.

    Its inputs are the signals of the formulas. Its outputs are, for each formula, the result of a
    step of `watch` and the ends of its interval: `robustness`, `robustness_low` and
    `robustness_high`, or names made from those of the formulas. A step samples the inputs set
    before it.

    **Arguments:**
    - `dt`: sampling period in seconds; communication steps must be multiples of it.
    - `file`: the FMU to write.
    - `semantics`, `every`, `sizes`, `units`: as in `export_c`.
    **Returns:** the path of the file. It contains a binary for this machine if there is a compiler,
    otherwise only the source, which the importing tool has to compile.
    **Raises:** the errors of `export_c`; `ValueError` for a file whose name does not end in `.fmu`,
    and for a formula with the name of a signal.
    """
    path = Path(file)
    if path.suffix != ".fmu":
        raise ValueError(f"the name of an FMU ends in .fmu; got {path.name}")
    formulas = completed(formulas, units, sizes)
    plan = streams(formulas, dt, semantics, every)
    front = margins(plan, sizes or {})
    inputs = [n if i is None else f"{n}[{i}]" for n, i in front.columns]
    outputs = [f"{key or 'robustness'}{kind}" for key in plan.formulas for kind in KINDS]
    twice = sorted({name for name in inputs + outputs if (inputs + outputs).count(name) > 1})
    if twice:
        raise ValueError(
            f"{counted(len(twice), 'variable')} of the FMU would have one name with another: "
            f"{', '.join(twice)}; name the formulas, as in {{'gap_kept': 'always gap > 2'}}"
        )
    for name in (path.stem, *inputs, *outputs):
        check_name("a name in an FMU", name)
    header = export_c(formulas, dt, semantics=semantics, every=every, sizes=sizes)
    parts = {"columns": max(1, len(inputs)), "outputs": len(plan.outputs), "dt": repr(dt)}
    wrapper = re.sub(r"@(columns|outputs|dt)", lambda found: str(parts[found[1]]), WRAPPER)
    stubs = [
        _stub(given, status) for some, status in ((NOTHING, 0), (REFUSED, 3)) for given in some
    ]
    source = "\n".join([header, wrapper, *stubs, "#ifdef __cplusplus\n}\n#endif\n"])
    guid = hashlib.sha256(source.encode()).hexdigest()[:32]
    source = source.replace("@guid", guid)
    target = "darwin64/monitor.dylib" if sys.platform == "darwin" else "linux64/monitor.so"
    with (
        tempfile.TemporaryDirectory() as made,
        replacing(path) as partial,
        zipfile.ZipFile(partial, "w") as archive,
    ):
        archive.writestr("modelDescription.xml", _description(path, guid, dt, inputs, outputs))
        archive.writestr("sources/monitor.c", source)
        with contextlib.suppress(Unavailable):
            binary = compile_library(Path(made), "monitor", source, FLAGS)
            archive.write(binary, f"binaries/{target}")
    return path


def _stub(given: str, status: int) -> str:
    """Return a function of the standard that only returns a status."""
    name, *arguments = given.split(", ")
    names = ["c", *(re.findall(r"\w+", argument)[-1] for argument in arguments)]
    ignored = " ".join(f"(void){name};" for name in names)
    return (
        f"VJ_EXPORT int fmi2{name}({', '.join(['void *c', *arguments])}) "
        f"{{ {ignored} return {status}; }}"
    )


def _description(path: Path, guid: str, dt: float, inputs: list[str], outputs: list[str]) -> bytes:
    root = ElementTree.Element(
        "fmiModelDescription", fmiVersion="2.0", modelName=path.stem, guid=guid,
        generationTool="verifai_jax", variableNamingConvention="structured",
    )  # fmt: skip
    kind = ElementTree.SubElement(
        root, "CoSimulation", modelIdentifier="monitor", canGetAndSetFMUstate="true",
        canHandleVariableCommunicationStepSize="true", canNotUseMemoryManagementFunctions="true",
    )  # fmt: skip
    files = ElementTree.SubElement(kind, "SourceFiles")
    ElementTree.SubElement(files, "File", name="monitor.c")
    ElementTree.SubElement(root, "DefaultExperiment", stepSize=repr(dt))
    variables = ElementTree.SubElement(root, "ModelVariables")
    structure = ElementTree.SubElement(root, "ModelStructure")
    listed = [ElementTree.SubElement(structure, tag) for tag in ("Outputs", "InitialUnknowns")]
    references = [*range(len(inputs)), *(max(1, len(inputs)) + k for k in range(len(outputs)))]
    for index, (name, reference) in enumerate(zip(inputs + outputs, references, strict=True)):
        given = index < len(inputs)
        about = {"causality": "input", "variability": "continuous"}
        if not given:
            about = {"causality": "output", "variability": "discrete", "initial": "calculated"}
        variable = ElementTree.SubElement(
            variables, "ScalarVariable", {"name": name, "valueReference": str(reference), **about}
        )
        ElementTree.SubElement(variable, "Real", {"start": "0"} if given else {})
        for part in () if given else listed:
            ElementTree.SubElement(part, "Unknown", index=str(index + 1), dependencies="")
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
