"""Monitors as C99 in one header, without allocation and with memory fixed by the windows.

    Path("gap.h").write_text(export_c("always (gap > 2)", dt=0.1, name="gap"))

Its helpers are the operations of `host_streams`. Functions have one exit and loops have an end.
"""

import functools
import math
import re
from collections.abc import Mapping, Sequence

from verifai_jax.addons.monitoring.error_bars import ErrorBars, bounded
from verifai_jax.addons.monitoring.margins import Margins, Step, margins
from verifai_jax.addons.monitoring.quantities import completed
from verifai_jax.core.messages.text import printable
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.semantics import Semantics, hard
from verifai_jax.mtl.streams import Op, Plan, streams
from verifai_jax.mtl.tree import missing_case
from verifai_jax.mtl.words import number_text

HEAD = "#include <math.h>\n#include <stdbool.h>\n#include <stdint.h>\n"
TAKEN = re.compile(
    # Words of C and C++, in which a header may be included, ...
    "alignas|alignof|and|and_eq|asm|auto|bitand|bitor|bool|break|case|catch|char\\w*|class|compl|"
    "concept|const\\w*|continue|co_\\w+|decltype|default|delete|do|double\\w*|dynamic_cast|else|enum|"
    "explicit|export|extern|false|float\\w*|for|friend|goto|if|inline|int|linux|long|mutable|namespace|"
    "new|noexcept|not|not_eq|nullptr|operator|or|or_eq|private|protected|public|register|"
    "reinterpret_cast|requires|restrict|return|short|signed|sizeof|static\\w*|struct|switch|template|"
    "this|thread_local|throw|true|try|type\\w+|union|unix|unsigned|using|virtual|void|volatile|wchar_t|"
    "while|xor|xor_eq|"
    # ... names of the headers ...
    "[A-Z][A-Z0-9_]*|u?int\\w*_t|(?:a?(?:cos|sin|tan)h?|atan2|cbrt|ceil|copysign|erfc?|exp2?|expm1|fabs|"
    "fdim|floor|fma|fmax|fmin|fmod|frexp|hypot|ilogb|ldexp|lgamma|l?l?rint|l?l?round|log|log10|log1p|"
    "log2|logb|modf|nan|nearbyint|nextafter|nexttoward|pow|remainder|remquo|scalbl?n|sqrt|tgamma|trunc|"
    "gamma|drem|significand|scalb|finite|pow10|exp10|isnan|isinf|signgam|[jy](?:0|1|n))[fl]?|"
    "is\\w+|signbit|fpclassify|"
    # ... and variables of the code.
    "vj_\\w+|m|x|i|k|out|low|high|scratch|held|leaf|waits|[avyn]\\d+"
)
"""Names that no monitor in C can have."""
HELPERS = r"""
#ifndef VJ_MONITOR_HELPERS
#define VJ_MONITOR_HELPERS

/* The greatest (sign 1) or least (sign -1) of two numbers; NaN if one is. */
static inline double vj_best(int32_t sign, double a, double b)
{
  const bool second = (sign > 0) ? (b > a) : (b < a);
  return (second || (b != b)) ? b : a;
}

static inline double vj_power(double x, int32_t n)
{
  double result = 1.0;
  double base = x;
  int32_t left = (n < 0) ? -n : n;
  while (left > 0) {
    if ((left % 2) == 1) { result = result * base; }
    left = left / 2;
    if (left > 0) { base = base * base; }
  }
  return (n < 0) ? (1.0 / result) : result;
}

static inline double vj_truth(double margin, bool at_zero)
{
  const bool holds = at_zero ? (margin >= 0.0) : (margin > 0.0);
  return (margin != margin) ? margin : (holds ? 1.0 : -1.0);
}

static inline void vj_fill(double *to, int32_t n, double number)
{
  for (int32_t i = 0; i < n; i++) { to[i] = number; }
}

/* Whether one of the margins is NaN. */
static inline bool vj_unknown(const double *leaf, int32_t n)
{
  bool unknown = false;
  for (int32_t i = 0; i < n; i++) { unknown = unknown || (leaf[i] != leaf[i]); }
  return unknown;
}

/* The margins, with a bound for each that is NaN. */
static inline void vj_bound(double *to, const double *leaf, int32_t n, double bound)
{
  for (int32_t i = 0; i < n; i++) { to[i] = (leaf[i] != leaf[i]) ? bound : leaf[i]; }
}

/* 1 if something holds and 0 if not, of its truth; NaN if that is unknown. */
static inline double vj_held(double truth)
{
  return (truth != truth) ? truth : ((truth > 0.0) ? 1.0 : 0.0);
}

/* The value at the latest event, or at the first sample; NaN while it is unknown whether it was. */
static inline double vj_latest(double *kept, bool first, double event, double x)
{
  if (event != event) { *kept = event; }
  else if (first || (event > 0.0)) { *kept = x; }
  else { /* nothing new */ }
  return *kept;
}

/* The value n samples ago. */
static inline double vj_delay(double *ring, int32_t n, int32_t *at, double x)
{
  const double before = ring[*at];
  ring[*at] = x;
  *at = ((*at + 1) < n) ? (*at + 1) : 0;
  return before;
}

/* The extreme of the last n values: of what is left of the block before, and of this block. */
static inline double vj_window(
  int32_t sign, double *block, int32_t n, int32_t *at, double *run, double x)
{
  const int32_t k = *at;
  double result = (k == 0) ? x : vj_best(sign, *run, x);
  *run = result;
  block[k] = x;
  if (k == (n - 1)) {
    for (int32_t i = n - 2; i >= 0; i--) { block[i] = vj_best(sign, block[i], block[i + 1]); }
    *at = 0;
  } else {
    result = vj_best(sign, result, block[k + 1]);
    *at = k + 1;
  }
  return result;
}

/* Two neighbouring parts of until (or since) as one: g of both. */
static inline double vj_both(
  int32_t sign, bool since, double f, double g, double newer_f, double newer_g)
{
  return since ? vj_best(sign, newer_g, vj_best(-sign, newer_f, g))
               : vj_best(sign, g, vj_best(-sign, f, newer_g));
}

static inline double vj_pairs(
  int32_t sign, bool since, double *fs, double *gs, int32_t n, int32_t *at,
  double *run_f, double *run_g, double f, double g)
{
  const int32_t k = *at;
  double result = (k == 0) ? g : vj_both(sign, since, *run_f, *run_g, f, g);
  *run_f = (k == 0) ? f : vj_best(-sign, *run_f, f);
  *run_g = result;
  fs[k] = f;
  gs[k] = g;
  if (k == (n - 1)) {
    for (int32_t i = n - 2; i >= 0; i--) {
      gs[i] = vj_both(sign, since, fs[i], gs[i], fs[i + 1], gs[i + 1]);
      fs[i] = vj_best(-sign, fs[i], fs[i + 1]);
    }
    *at = 0;
  } else {
    result = vj_both(sign, since, fs[k + 1], gs[k + 1], *run_f, *run_g);
    *at = k + 1;
  }
  return result;
}

/* The extreme from one instant to another; while it is to come, with the value of now. */
static inline double vj_accumulate(
  int32_t sign, int64_t index, int64_t start, int64_t end, double *run, double x)
{
  const double before = *run;
  const double with = vj_best(sign, before, x);
  if ((index >= start) && (index <= end)) { *run = with; }
  return (index < 0) ? (double)NAN : ((index <= end) ? with : before);
}

static inline double vj_reach(
  int32_t sign, int64_t index, int64_t start, int64_t end, double *found, double *kept,
  double f, double g)
{
  const double before = *found;
  const double through = vj_best(-sign, *kept, f);
  const double until_now = (index >= start) ? *kept : through;
  const double coming = vj_best(sign, before, vj_best(-sign, g, until_now));
  if ((index >= start) && (index <= end)) {
    *found = vj_best(sign, before, vj_best(-sign, g, *kept));
  }
  if (index >= 0) { *kept = through; }
  return (index < 0) ? (double)NAN : ((index <= end) ? coming : before);
}

#endif
"""
MONITOR = r"""
typedef struct {
  double out[@outputs];
  double leaf[@leaves];
  int64_t count;
@fields
} @name_stream;

/* Unknown margins (NaN) are the lowest and the greatest in low and high, used from the first on. */
typedef struct {
  double out[@outputs];
  bool gaps;
  @name_stream now, low, high;
@counted
} @name;

/* Before any sample. */
static inline void @name_clear(@name_stream *m)
{
  vj_fill(m->out, @outputs, (double)NAN);
  vj_fill(m->leaf, @leaves, (double)NAN);
  m->count = 0;
@starts
}

static inline void @name_start(@name *m)
{
  vj_fill(m->out, @outputs, (double)NAN);
  m->gaps = false;
  @name_clear(&m->now);
@counted_starts
}

/* One more instant, at which the margins are those of m->leaf. */
static inline void @name_follow(@name_stream *m)
{
@ops
  m->count++;
}

/* One more sample; m->out has the results. */
static inline void @name_step(@name *m, const double x[@columns])
{
@margins
  if (!m->gaps && vj_unknown(m->now.leaf, @leaves)) {
    m->gaps = true;
    m->low = m->now;
    m->high = m->now;
  }
  if (m->gaps) {
    vj_bound(m->low.leaf, m->now.leaf, @leaves, @lowest);
    vj_bound(m->high.leaf, m->now.leaf, @leaves, @top);
    @name_follow(&m->low);
    @name_follow(&m->high);
  }
  @name_follow(&m->now);
  for (int32_t k = 0; k < @outputs; k++) { m->out[k] = m->now.out[k]; }
}

/* What the results will be if all margins are held (or, if not, of this value) from now on. */
static inline void @name_end(
  const @name_stream *m, @name_stream *scratch, bool held, double leaf, double out[@outputs])
{
  static const int32_t waits[@outputs] = { @waits };
  *scratch = *m;
  if (!held) { vj_fill(scratch->leaf, @leaves, leaf); }
  for (int32_t i = 0; i <= @longest; i++) {
    for (int32_t k = 0; k < @outputs; k++) {
      if (waits[k] == i) { out[k] = scratch->out[k]; }
    }
    @name_follow(scratch);
  }
}

/* The lowest and the greatest robustness that further samples, and unknown ones, allow. */
static inline void @name_interval(
  const @name *m, @name *scratch, double low[@outputs], double high[@outputs])
{
  @name_end(m->gaps ? &m->low : &m->now, &scratch->now, false, @lowest, low);
  @name_end(m->gaps ? &m->high : &m->now, &scratch->now, false, @top, high);
}

/* The robustness if this was the last sample. */
static inline void @name_finish(const @name *m, @name *scratch, double out[@outputs])
{
  @name_end(&m->now, &scratch->now, true, 0.0, out);
}
"""


def export_c(
    formulas: Formula | str | Mapping[str, Formula | str], dt: float, name: str = "monitor", *,
    semantics: Semantics = hard, every: bool = False, sizes: Mapping[str, int] | None = None,
    units: Mapping[str, str] | None = None, error_bars: ErrorBars | None = None,
) -> str:  # fmt: skip
    """Return a C99 header with a monitor of one formula, or of several by name.

    Its `NAME_start`, `NAME_step`, `NAME_interval` and `NAME_finish` correspond to the methods of
    `watch`, with the same values if compiled with `-ffp-contract=off`. It allocates no memory, and
    includes only `math.h`, `stdbool.h` and `stdint.h`.

    **Arguments:**
    - `dt`: sampling period in seconds.
    - `name`: the name of the C type, and the prefix of its functions.
    - `semantics`: `hard` or `boolean`.
    - `every`: whether each formula is evaluated at every instant, not only at time 0.
    - `sizes`, `units`: as in `watch`.
    - `error_bars`: as in `watch`; each formula has two results, the least and the greatest value.
    **Returns:** the text of the header.
    **Raises:** the errors of `watch`; `ValueError` for a name that is not a C identifier, or that C
    or the code itself uses.
    """
    if not re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII):
        raise ValueError(
            f"the name of a monitor in C is a letter, then letters, digits and _; got {name!r}"
        )
    if TAKEN.fullmatch(name):
        raise ValueError(
            f"the name of a monitor must be free in C, where {name!r} means something else or may; "
            f"such as {name.lower()}_monitor"
        )
    wanted = completed(formulas, units, sizes)
    if error_bars is not None:
        wanted = bounded(wanted, error_bars)
    plan = streams(wanted, dt, semantics, every)
    front = margins(plan, sizes or {})
    columns = [
        f"x[{k}] {n}{'' if i is None else f'[{i}]'}" for k, (n, i) in enumerate(front.columns)
    ]
    outputs = [
        f"out[{k}] {key}{': ' * bool(key)}{f}" for k, (key, f) in enumerate(plan.formulas.items())
    ]
    about = "\n".join(["", *outputs, *columns, f"a sample every {number_text(dt)} s"])
    # Nothing in it ends the comment, begins another, joins lines or is a trigraph.
    apart = re.sub(r"(?<=\*)(?=/)|(?<=/)(?=\*)|(?<=\?)(?=\?)", " ", printable(about))
    comment = re.sub(r"\\(?=\n)", "\\\\|", apart).replace("\n", "\n * ")
    guard = f"VJ_MONITOR_{name.upper()}_H"
    body = monitor_code(plan, front, name)
    return f"/*{comment}\n */\n#ifndef {guard}\n#define {guard}\n\n{HEAD}{HELPERS}{body}\n#endif\n"


def monitor_code(plan: Plan, front: Margins, name: str) -> str:
    """Return the type of a monitor and its functions, without the functions they call."""
    code, counted = _Code(plan.top), _Code(plan.top)
    inner, counts = [], []
    for k, (within, own, columns) in enumerate(front.counts):
        inner.append(monitor_code(within, own, f"{name}_counted{k}"))
        counts += counted.count(k, columns, f"{name}_counted{k}")
    values = [
        f"({_number(op.number)})" if op.kind == "number" else f"v{k}"
        for k, op in enumerate(plan.ops)
    ]
    ops = [code.stream(k, op, values) for k, op in enumerate(plan.ops) if op.kind != "number"]
    outputs = [
        f"m->out[{k}] = (m->count >= {o.delay}) ? {values[o.slot]} : (double)NAN;"
        for k, o in enumerate(plan.outputs)
    ]
    waits = [output.wait for output in plan.outputs]
    lines, texts = _margin_lines(front, counted)
    given = [f"m->now.leaf[{k}] = {texts[i]};" for k, i in enumerate(front.leaves)]
    given = given or ["(void)x;", "m->now.leaf[0] = 0.0;"]
    parts = {
        "outputs": len(outputs), "leaves": max(1, len(front.leaves)),
        "columns": max(1, len(front.columns)), "fields": _lines(code.fields),
        "starts": _lines(code.starts), "ops": _lines([*ops, *outputs]),
        "counted": _lines(counted.fields), "counted_starts": _lines(counted.starts),
        "margins": _lines([*counts, *lines, *given]), "longest": max(waits),
        "waits": ", ".join(map(str, waits)), "lowest": _number(-plan.top), "top": _number(plan.top),
    }  # fmt: skip
    text = re.sub(r"@(name)", name, MONITOR)
    return "".join([*inner, re.sub(r"@(\w+)", lambda found: str(parts[found[1]]), text)])


def _margin_lines(front: Margins, memory: "_Code") -> tuple[list[str], list[str]]:
    """Return a line for each operation, and the text by which its result is read."""
    lines: list[str] = []
    texts: list[str] = []
    for step in front.steps:
        match step.kind:
            case "column" | "count":
                text = ("x[{}]" if step.kind == "column" else "n{}").format(int(step.number))
            case "number":
                text = f"({step.number!r})"
            case _:
                text = f"a{len(texts)}"
                of = _operation(step, [texts[i] for i in step.inputs], memory, len(texts))
                *before, value = of.split("\n")
                lines += before
                lines.append(f"const double {text} = {value};")
        texts.append(text)
    return lines, texts


def _operation(step: Step, v: Sequence[str], memory: "_Code", k: int) -> str:
    n = int(step.number)
    match step.kind:
        case "delay" | "lag":
            ring, at = memory.array(f"s{k}", n, 0.0), memory.index(f"t{k}")
            fill = f"if (m->now.count == 0) {{ vj_fill({ring}, {n}, {v[0]}); }}"
            delay = f"vj_delay({ring}, {n}, {at}, {v[0]})"
            return f"{fill}\n{delay}" if step.kind == "lag" else delay
        case "latest":
            kept = memory.number(f"s{k}", 0.0)
            return f"vj_latest({kept}, m->now.count == 0, {v[0]}, {v[1]})"
        case "+" | "-" | "*" | "/":
            return f"{v[0]} {step.kind} {v[1]}"
        case "neg":
            return f"-{v[0]}"
        case "min" | "max":
            sign = 1 if step.kind == "max" else -1
            return functools.reduce(lambda a, b: f"vj_best({sign}, {a}, {b})", v)
        case "norm":
            return f"sqrt({' + '.join(f'({a} * {a})' for a in v)})"
        case "power":
            return f"vj_power({v[0]}, {n})"
        case "truth":
            return f"vj_truth({v[0]}, {str(bool(step.number)).lower()})"
    function = {"abs": "fabs", "**": "pow"}.get(step.kind, step.kind)
    return f"{function}({', '.join(v)})"


def _lines(lines: Sequence[str]) -> str:
    return "\n".join(f"  {line}" for line in lines)


def _number(value: float) -> str:
    if math.isinf(value):
        return "(double)INFINITY" if value > 0 else "-(double)INFINITY"
    return repr(float(value))


class _Code:
    """Declares the memory of operations, and writes each as a line of C."""

    def __init__(self, top: float) -> None:
        self.top = top
        self.fields: list[str] = []
        self.starts: list[str] = []

    def array(self, name: str, n: int, number: float) -> str:
        self.fields.append(f"double {name}[{n}];")
        self.starts.append(f"vj_fill(m->{name}, {n}, {_number(number)});")
        return f"m->{name}"

    def number(self, name: str, number: float) -> str:
        self.fields.append(f"double {name};")
        self.starts.append(f"m->{name} = {_number(number)};")
        return f"&m->{name}"

    def index(self, name: str) -> str:
        self.fields.append(f"int32_t {name};")
        self.starts.append(f"m->{name} = 0;")
        return f"&m->{name}"

    def count(self, k: int, columns: Sequence[int], kind: str) -> list[str]:
        """Return the lines that tell what holds, by a monitor of the `kind` within this one."""
        self.fields.append(f"{kind} m{k};")
        self.starts.append(f"{kind}_start(&m->m{k});")
        given = ", ".join(f"x[{column}]" for column in columns) or "0.0"
        return [
            f"const double y{k}[] = {{ {given} }};",
            f"{kind}_step(&m->m{k}, y{k});",
            f"const double n{k} = vj_held(m->m{k}.out[0]);",
        ]

    def stream(self, k: int, op: Op, names: Sequence[str]) -> str:
        """Return the lines that compute an operation."""
        *before, value = self._stream(k, op, [names[i] for i in op.inputs]).split("; ")
        return ";\n  ".join([*before, f"const double v{k} = {value};"])

    def _stream(self, k: int, op: Op, v: Sequence[str]) -> str:
        sign, since = op.sign, str(op.kind == "since").lower()
        end = "INT64_MAX" if math.isinf(op.end) else int(op.end)
        index = f"m->count - {op.n}, {op.start}, {end}"
        match op.kind:
            case "leaf":
                return f"m->leaf[{op.n}]"
            case "join":
                return functools.reduce(lambda a, b: f"vj_best({sign}, {a}, {b})", v)
            case "begun":
                return f"(m->count >= {op.n}) ? {v[0]} : {_number(op.number)}"
            case "delay":
                ring = self.array(f"w{k}", op.n, op.number)
                return f"vj_delay({ring}, {op.n}, {self.index(f'k{k}')}, {v[0]})"
            case "window":
                ring, at = self.array(f"w{k}", op.n, op.number), self.index(f"k{k}")
                run = self.number(f"r{k}", op.number)
                return f"vj_window({sign}, {ring}, {op.n}, {at}, {run}, {v[0]})"
            case "running":
                run = self.number(f"r{k}", op.number)[1:]
                return f"{run} = vj_best({sign}, {run}, {v[0]}); {run}"
            case "recur":
                run = self.number(f"r{k}", -sign * self.top)[1:]
                return f"{run} = vj_best({sign}, {v[1]}, vj_best({-sign}, {v[0]}, {run})); {run}"
            case "until" | "since":
                top = sign * self.top
                fs, gs = self.array(f"f{k}", op.n, top), self.array(f"w{k}", op.n, -top)
                runs = f"{self.number(f'p{k}', top)}, {self.number(f'r{k}', -top)}"
                rooms = f"{fs}, {gs}, {op.n}, {self.index(f'k{k}')}, {runs}"
                return f"vj_pairs({sign}, {since}, {rooms}, {v[0]}, {v[1]})"
            case "accumulate":
                run = self.number(f"r{k}", -sign * self.top)
                return f"vj_accumulate({sign}, {index}, {run}, {v[0]})"
            case "reach":
                top = sign * self.top
                runs = f"{self.number(f'r{k}', -top)}, {self.number(f'p{k}', top)}"
                return f"vj_reach({sign}, {index}, {runs}, {v[0]}, {v[1]})"
        raise missing_case("the exported monitor", op)
