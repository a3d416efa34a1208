"""The speed of the monitor, beside `np.min` over the same array, and beside other monitors.

    python benchmarks/monitor.py                      # T = 1000, batch 256: the goals
    python benchmarks/monitor.py --full               # T in 100, 1000, 10000; batch 1, 256, 4096
    python benchmarks/monitor.py --markdown           # the same as tables

Everything runs in one process and alternates with what it is compared to, so that a busy machine
disturbs both; ratios are medians of paired ratios. Compile time is reported apart. The other
monitors come with the extra `bench` and are left out, with a line, where they are not installed.
"""

import argparse
import itertools
import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

os.environ.setdefault("VERIFAI_JAX_CACHE", "off")

import jax
import numpy as np

import verifai_jax as vj
from verifai_jax.mtl._robustness import LANES

SHAPES = {
    "G p": "G (p > 0)",
    "F p": "F (p > 0)",
    "G(p -> F[0,10] q)": "G ((p > 0) -> F[0,10] (q > 0))",
    "G(p -> F[0,500] q)": "G ((p > 0) -> F[0,500] (q > 0))",
    "G F[0,10] G[0,20] p": "G F[0,10] G[0,20] (p > 0)",
    "p U q": "(p > 0) U (q > 0)",
    "G(p U[5,50] q)": "G ((p > 0) U[5,50] (q > 0))",
}
SEMANTICS = {"hard": vj.mtl.hard, "smooth": vj.mtl.smooth(0.1)}

#: Goals at T=1000 and batch 256, as multiples of `np.min(axis=0)`.
GOALS = {
    "G p": 4, "F p": 4, "G(p -> F[0,10] q)": 25, "G(p -> F[0,500] q)": 25,
    "G F[0,10] G[0,20] p": 45, "G(p U[5,50] q)": 80,
}  # fmt: skip


def seconds(run: Callable[[], Any]) -> float:
    start = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - start


def paired(run: Callable[[], Any], other: Callable[[], Any], repeats: int) -> tuple[float, float]:
    """Median seconds of `run`, and the median of its ratios to `other` run right before."""
    run(), other()
    times, ratios = [], []
    for _ in range(repeats):
        base = seconds(other)
        times.append(seconds(run))
        ratios.append(times[-1] / base)
    return float(np.median(times)), float(np.median(ratios))


@dataclass
class Measured:
    shape: str
    semantics: str
    length: int
    batch: int
    forward_ns: float
    to_min: float
    gradient_ratio: float
    compile_s: float
    arrays: float
    gradient_arrays: float


def signals(length: int, batch: int) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    return {n: rng.standard_normal((length, batch)).astype(np.float32) for n in ("p", "q")}


def measure(shape: str, semantics: str, length: int, batch: int, repeats: int) -> Measured:
    formula = vj.parse(SHAPES[shape])
    data = signals(length, batch)
    used = {name: jax.numpy.asarray(data[name]) for name in formula.signals()}

    def rho(signals: dict[str, Any]) -> Any:
        return vj.robustness(formula, vj.Trace(signals, dt=1.0), SEMANTICS[semantics])

    start = time.perf_counter()
    forward = jax.jit(jax.vmap(rho, in_axes=1)).lower(used).compile()
    compile_s = time.perf_counter() - start
    gradient = (
        jax.jit(jax.vmap(jax.value_and_grad(rho), in_axes=1, out_axes=(0, 1))).lower(used).compile()
    )
    whole, ratio = paired(lambda: forward(used), lambda: np.min(data["p"], axis=0), repeats)
    _, backward = paired(lambda: gradient(used), lambda: forward(used), repeats)
    chunk = 4 * length * min(batch, LANES)
    memory = [
        program.memory_analysis().temp_size_in_bytes / chunk for program in (forward, gradient)
    ]
    ns = whole / (length * batch) * 1e9
    return Measured(shape, semantics, length, batch, ns, ratio, backward, compile_s, *memory)


def window_independence(repeats: int) -> float:
    """Time of `F[0,500]` over that of `F[0,10]`, in the same formula."""
    data = {k: jax.numpy.asarray(v) for k, v in signals(1000, 256).items()}
    programs = []
    for shape in ("G(p -> F[0,500] q)", "G(p -> F[0,10] q)"):
        formula = vj.parse(SHAPES[shape])

        def rho(signals: dict[str, Any], formula: Any = formula) -> Any:
            return vj.robustness(formula, vj.Trace(signals, dt=1.0))

        programs.append(jax.jit(jax.vmap(rho, in_axes=1)).lower(data).compile())
    long, short = programs
    return paired(lambda: long(data), lambda: short(data), repeats)[1]


# Other monitors: ns per trace-sample of one trace, or a reason why not


def rtamt(shape: str, data: dict[str, Any], repeats: int) -> float:
    import rtamt

    specification = rtamt.StlDiscreteTimeSpecification()
    for name in ("p", "q"):
        specification.declare_var(name, "float")
    specification.spec = {
        "G p": "always(p > 0.0)",
        "F p": "eventually(p > 0.0)",
        "G(p -> F[0,10] q)": "always((p > 0.0) implies (eventually[0:10](q > 0.0)))",
        "G(p -> F[0,500] q)": "always((p > 0.0) implies (eventually[0:500](q > 0.0)))",
        "G F[0,10] G[0,20] p": "always(eventually[0:10](always[0:20](p > 0.0)))",
        "p U q": "(p > 0.0) until (q > 0.0)",
        "G(p U[5,50] q)": "always((p > 0.0) until[5:50] (q > 0.0))",
    }[shape]
    specification.parse()
    length = len(data["p"])
    recording = {"time": list(range(length)), **{n: data[n][:, 0].tolist() for n in ("p", "q")}}
    return min(seconds(lambda: specification.evaluate(recording)) for _ in range(repeats)) / length


def pymtl(shape: str, data: dict[str, Any], repeats: int) -> float:
    import mtl

    formula = mtl.parse(
        {
            "G p": "G(p)",
            "F p": "F(p)",
            "G(p -> F[0,10] q)": "G(p -> F[0,10] q)",
            "G(p -> F[0,500] q)": "G(p -> F[0,500] q)",
            "G F[0,10] G[0,20] p": "G(F[0,10](G[0,20](p)))",
        }[shape]
    )
    length = min(100, len(data["p"]))  # Its cost grows faster than the trace.
    recording = {n: list(enumerate(data[n][:length, 0].tolist())) for n in ("p", "q")}
    return (
        min(seconds(lambda: formula(recording, quantitative=True)) for _ in range(repeats)) / length
    )


def stljax(shape: str, data: dict[str, Any], repeats: int) -> float:
    from stljax import formula as stl

    p = stl.Predicate("p", lambda s: s[:, 0]) > 0.0
    q = stl.Predicate("q", lambda s: s[:, 1]) > 0.0
    formula = {
        "G p": lambda: stl.Always(p),
        "F p": lambda: stl.Eventually(p),
        "G(p -> F[0,10] q)": lambda: stl.Always(stl.Implies(p, stl.Eventually(q, [0, 10]))),
        "G(p -> F[0,500] q)": lambda: stl.Always(stl.Implies(p, stl.Eventually(q, [0, 500]))),
        "G F[0,10] G[0,20] p": lambda: stl.Always(stl.Eventually(stl.Always(p, [0, 20]), [0, 10])),
    }[shape]()  # Its until needs several T x T arrays for each trace: too much memory.
    batch = jax.numpy.stack([data["p"].T, data["q"].T], axis=-1)[:16]
    run = jax.jit(jax.vmap(formula.robustness))
    jax.block_until_ready(run(batch))
    return min(seconds(lambda: run(batch)) for _ in range(repeats)) / batch[..., 0].size


PEERS = {"rtamt": rtamt, "metric-temporal-logic": pymtl, "stljax": stljax}


def compare_peers(table: "Table", results: list[Measured], repeats: int) -> None:
    data = signals(1000, 256)
    table.head("shape", "peer", "ns/sample", "x ours")
    absent = set()
    for ours in results:
        if ours.semantics != "hard" or (ours.length, ours.batch) != (1000, 256):
            continue
        for name, peer in PEERS.items():
            if name in absent:
                continue
            try:
                ns = peer(ours.shape, data, repeats) * 1e9
            except ImportError as error:
                absent.add(name)
                table.note(f"{name} is left out: {error}")
            except KeyError:
                table.row(ours.shape, name, "not comparable", "")
            except Exception as error:
                # Another library's failure is a result, not a reason to stop.
                table.row(ours.shape, name, f"{type(error).__name__}", "")
            else:
                table.row(ours.shape, name, f"{ns:.0f}", f"{ns / ours.forward_ns:.0f}")


class Table:
    """Prints rows as they come, as aligned text or as Markdown."""

    def __init__(self, markdown: bool) -> None:
        self.markdown = markdown

    def head(self, *cells: str) -> None:
        print()
        self.row(*cells)
        if self.markdown:
            print("|" + " --- |" * len(cells))

    def row(self, *cells: str) -> None:
        if self.markdown:
            print("| " + " | ".join(cells) + " |", flush=True)
        else:
            print(f"{cells[0]:22s}" + "".join(f" {cell:>12s}" for cell in cells[1:]), flush=True)

    def note(self, text: str) -> None:
        print(f"\n{text}\n" if self.markdown else text, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--full", action="store_true", help="all lengths and batch sizes")
    parser.add_argument("--markdown", action="store_true")
    parser.add_argument("--repeats", type=int, default=60)
    options = parser.parse_args()
    sizes = [(1000, 256)]
    if options.full:
        sizes = list(itertools.product((100, 1000, 10000), (1, 256, 4096)))
    table = Table(options.markdown)
    baseline = signals(1000, 256)["p"]
    unit, _ = paired(lambda: np.min(baseline, axis=0), lambda: None, options.repeats)
    table.note(
        f"jax {jax.__version__}, numpy {np.__version__}, {platform.machine()}, "
        f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; np.min(axis=0) takes "
        f"{unit / baseline.size * 1e9:.2f} ns per sample at T=1000, batch 256. "
        "Memory is in arrays of one chunk."
    )
    table.head(
        "shape", "semantics", "T", "batch", "ns/sample", "x np.min", "goal", "grad/value",
        "compile s", "memory", "with grad",
    )  # fmt: skip
    results = []
    for length, batch in sizes:
        repeats = max(5, min(options.repeats, int(2e9 / (length * batch * 20))))
        for shape, semantics in itertools.product(SHAPES, SEMANTICS):
            m = measure(shape, semantics, length, batch, repeats)
            results.append(m)
            has_goal = semantics == "hard" and (length, batch) == (1000, 256) and shape in GOALS
            table.row(
                shape, semantics, str(length), str(batch), f"{m.forward_ns:.2f}",
                f"{m.to_min:.1f}", str(GOALS[shape]) if has_goal else "",
                f"{m.gradient_ratio:.2f}", f"{m.compile_s:.2f}", f"{m.arrays:.1f}",
                f"{m.gradient_arrays:.1f}",
            )  # fmt: skip
    ratio = window_independence(options.repeats)
    table.note(f"F[0,500] takes {ratio:.2f} times as long as F[0,10] (goal: 1.3 at most).")
    compare_peers(table, results, 3)


if __name__ == "__main__":
    main()
