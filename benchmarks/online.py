"""The speed of monitors that are fed sample by sample: Python, many at once, and C.

    python benchmarks/online.py                       # microseconds and nanoseconds a sample

Processor time of this process, and of `rtamt` on the same samples where the extra `bench` has
installed it. The first use compiles; that is not counted.
"""

import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import verifai_jax as vj

N = 50_000
C = 5_000_000
MAIN = r"""
#include <stdio.h>
#include <time.h>
static monitor m;
int main(void) {
  double x[2], sum = 0.0; unsigned seed = 1;
  monitor_start(&m);
  clock_t begin = clock();
  for (long i = 0; i < @n; i++) {
    for (int k = 0; k < 2; k++) { seed = seed * 1664525u + 1013904223u; x[k] = seed / 4e9 - 0.5; }
    monitor_step(&m, x); sum += m.out[0];
  }
  printf("%.2f\n", 1e9 * (double)(clock() - begin) / CLOCKS_PER_SEC / @n);
  return sum == 1.0;
}
"""


def nanoseconds(run: Callable[[], object], samples: int) -> float:
    begin = time.process_time()
    run()
    return 1e9 * (time.process_time() - begin) / samples


def in_c(formula: str) -> float:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "monitor.c"
        file.write_text(vj.mtl.export_c(formula, 1.0) + MAIN.replace("@n", str(C)))
        subprocess.run(["cc", "-O2", file, "-o", file.with_suffix(""), "-lm"], check=True)
        return float(subprocess.run([file.with_suffix("")], capture_output=True, check=True).stdout)


def in_rtamt(window: int, samples: list[dict[str, float]]) -> float:
    import rtamt

    monitor = rtamt.StlDiscreteTimeOnlineSpecification()
    for name in ("p", "q"):
        monitor.declare_var(name, "float")
    monitor.spec = f"once[0,{window}] (q > 0) or (p <= 0)"
    monitor.parse()

    def run() -> None:
        for k, sample in enumerate(samples):
            monitor.update(k, list(sample.items()))

    return nanoseconds(run, len(samples))


def main() -> None:
    values = np.random.default_rng(0).normal(size=(N, 2))
    signals = {"p": values[:, 0], "q": values[:, 1]}
    samples = [{"p": float(p), "q": float(q)} for p, q in values]
    print("a sample of p -> once[0,b] q: Python, interval, many at once, C")
    for window in (1, 10, 1000, 100_000):
        formula = f"p > 0 -> once[0, {window}] q > 0"
        one, many = (vj.mtl.watch(formula, 1.0, every=True) for _ in range(2))
        step = nanoseconds(lambda one=one: [one.step(s) for s in samples], N)
        interval = nanoseconds(lambda one=one: [one.interval() for _ in range(1000)], 1000)
        batch = nanoseconds(lambda many=many: many.steps(signals), N)
        print(f"b={window:<7} {step / 1e3:z.2f} us {interval / 1e3:z.1f} us "
              f"{batch:z.1f} ns {in_c(formula):z.1f} ns")  # fmt: skip
    try:
        print(f"rtamt, b=10: {in_rtamt(10, samples[:2000]) / 1e3:z.1f} us")
    except ImportError:
        print("rtamt is not installed")


if __name__ == "__main__":
    main()
