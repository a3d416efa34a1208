"""A program on the command line as a system.

    program("./sim --mass {mass} --seed {seed} --out {out}", timeout=20)      # writes a CSV file
    program(["julia", "sim.jl", "{features}"], dt=0.01, workers=4)            # prints CSV or JSON

No shell reads the command: each word of it is one argument, whatever a feature's value is.
"""

import concurrent.futures
import contextlib
import dataclasses
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import tempfile
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from verifai_jax.core.display.extensions import verb
from verifai_jax.core.messages.checks import check_count, check_positive
from verifai_jax.core.messages.errors import missing_name, suggests_options
from verifai_jax.core.messages.text import one_line
from verifai_jax.core.store.foreign_files import decoded, open_file, read_bytes
from verifai_jax.core.user_code.user_files import declared_files
from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.systems.base import Features, Outcome, Seed, System, outcome_of
from verifai_jax.systems.blackbox._blackbox import plain_leaves, seed_of, single_trace
from verifai_jax.systems.blackbox.trace_form import SignalNames, TraceForm

WORD = re.compile(r"\{([A-Za-z_][\w.\[\]]*)\}")
OWN = ("out", "features", "seed", "folder")
"""Words in braces that are no features."""
MAX_SAID = 1000
"""Characters of the end of the standard error in the message of a row."""


@dataclasses.dataclass(frozen=True, eq=False)
class Program(System):
    """A host system whose simulations are runs of a program; made by `program`."""

    black_box: ClassVar[bool] = True
    command: tuple[str, ...]
    output: str
    time: str
    dt_given: float | None
    timeout: float
    environment: Mapping[str, str]
    declared: TraceForm
    workers: int = 1

    def __call__(self, features: Features, key: Seed = None) -> Trace:
        """Simulate once.

        **Raises:** `RuntimeError`, `TimeoutError`: what went wrong, with the end of the standard
        error.
        """
        self.check(features)
        return single_trace(self.simulate_each([plain_leaves(features)], [seed_of(key)]))

    def abstract(self, features: Features) -> Trace | None:
        return self.declared.abstract()

    def may_draw(self, features: Features) -> bool:
        """Return whether the program is given a seed."""
        return any("{seed}" in word for word in self.command)

    def check(self, features: Features) -> None:
        """Refuse words in braces that are no features, and features that no word names."""
        named = [name for each in self.command for name in WORD.findall(each)]
        known = _by_name(features)
        for name in named:
            if name not in known and name not in OWN:
                raise missing_name("the command", "feature", name, [*known, *OWN])
        left = [name for name in features if not _is_named(name, named)]
        if left and "features" not in named:
            raise ValueError(
                f"the command does not say where the features {', '.join(left)} go: write "
                f"{{{left[0]}}}, or {{features}} for the name of a JSON file with all of them"
            )

    def simulate_each(
        self, features: Sequence[Features], seeds: Sequence[int]
    ) -> Iterator[tuple[int, Outcome]]:
        """Run the program for each row, several at a time; see `System.simulate_each`."""
        stopped = threading.Event()
        pool = concurrent.futures.ThreadPoolExecutor(self.workers)
        rows = {
            pool.submit(self._outcome, each, seed, stopped): index
            for index, (each, seed) in enumerate(zip(features, seeds, strict=True))
        }
        try:
            for done in concurrent.futures.as_completed(rows):
                yield rows[done], done.result()
        finally:
            stopped.set()
            pool.shutdown(cancel_futures=True)

    def _outcome(self, features: Features, seed: int, stopped: threading.Event) -> Outcome:
        with tempfile.TemporaryDirectory(prefix="vj-program-") as folder:
            failed = self._run(Path(folder), features, seed, stopped)
            if failed is not None:
                return failed
            outcome = outcome_of(lambda: self._trace(Path(folder)))
        if outcome.trace is not None or not outcome.message:
            return outcome
        # The name of the temporary folder would make each message another one.
        return outcome._replace(message=re.sub(re.escape(f"{folder}{os.sep}"), "", outcome.message))

    def _run(
        self, folder: Path, features: Features, seed: int, stopped: threading.Event
    ) -> Outcome | None:
        """Run the program, and return how it failed; None if it has ended well."""
        values = {"out": folder / self.output, "features": folder / "features.json", "seed": seed}
        values |= {**_by_name(features), "folder": folder}
        plain = {name: np.asarray(value).tolist() for name, value in _by_name(features).items()}
        values["features"].write_text(json.dumps(plain), encoding="utf-8")
        words = [WORD.sub(lambda found: _text(values[found[1]]), each) for each in self.command]
        with (folder / "stdout").open("wb") as out, (folder / "stderr").open("wb") as err:
            try:
                # A group of its own, so that its children end with it.
                process = subprocess.Popen(
                    words, stdin=subprocess.DEVNULL, stdout=out, stderr=err, start_new_session=True,
                    env={**os.environ, **self.environment},
                )  # fmt: skip
            except OSError as error:
                return Outcome(None, Status.ERROR, f"the program cannot start: {error}")
            try:
                ended = _wait(process, self.timeout, stopped)
            finally:
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        code = process.returncode
        if not ended:
            after = f"the program was ended after {self.timeout:zg} s"
            return Outcome(None, Status.TIMEOUT, f"{after}{_said(folder)}")
        if code:
            how = f"died by signal {-code}" if code < 0 else f"ended with exit status {code}"
            return Outcome(None, Status.ERROR, f"the program {how}{_said(folder)}")
        return None

    def _trace(self, folder: Path) -> Trace:
        path = folder / self.output
        if not any("{out}" in word or "{folder}" in word for word in self.command):
            path = folder / "stdout"
            with open_file(path) as file:
                begins = file.read(100).lstrip()[:1]
            path = path.rename(path.with_suffix(".json" if begins in (b"{", b"[") else ".csv"))
        elif not path.is_file():
            raise RuntimeError(f"the program has not written its result{_said(folder)}")
        options = {"time": self.time, "dt": self.dt_given}
        if path.suffix != ".json":
            trace = verb("recording")(path, **options)
        else:
            import pandas as pd

            text, _ = decoded(path, read_bytes(path))
            frame = pd.DataFrame(json.loads(text))
            trace = verb("recording")(frame, **options)
        # Words of one run are not those of another, and all traces have the same signals.
        signals = {name: each for name, each in trace.signals.items() if "=" not in name}
        return self.declared.accept(dataclasses.replace(trace, signals=signals))


@suggests_options
def program(
    command: str | Sequence[str],
    *,
    output: str = "out.csv",
    time: str = "time",
    dt: float | None = None,
    timeout: float = 60.0,
    workers: int = 1,
    environment: Mapping[str, str] | None = None,
    signals: SignalNames | None = None,
    length: int | None = None,
    files: Iterable[str | Path] = (),
) -> Program:
    """Make a system of a program that simulates once and ends.

    A run that fails is a row with status `error`, one that is too long has status `timeout`; the
    message has the end of what the program wrote to its standard error.

    **Arguments:**
    - `command`: the program and its arguments, as one text that is split at spaces (quotes join
      words), or a sequence. `{mass}` is a feature's value, `{p[0]}` an entry and `{car.mass}` a
      part of one; `{features}` is the name of a JSON file with all features, `{seed}` a number that
      is the same on every replay, `{out}` the name of the file that the program writes, and
      `{folder}` that of the temporary folder of this run. No shell is started.
    - `output`: the name of that file in the temporary folder; its ending says its format, `.json`
      or one that `vj.mtl.read` reads. Without `{out}` and `{folder}` in the command the program
      prints CSV or JSON. JSON is an object of lists by name, or a list of objects.
    - `time`, `dt`: the column of sample times in seconds, or the sampling period.
    - `timeout`: wall-clock seconds, after which the program and its children are killed.
    - `workers`: number of programs that run at a time.
    - `environment`: variables of its environment, beside those of this process.
    - `signals`, `length`, `files`: as in `blackbox`. A program that is named by its path is one of
      the files.
    **Raises:** `ValueError` for an empty command; `FileNotFoundError` for a missing program.
    """
    words = shlex.split(command) if isinstance(command, str) else [str(word) for word in command]
    if not words:
        raise ValueError("the command is empty: give a program and its arguments")
    found = shutil.which(words[0])
    if found is None:
        raise FileNotFoundError(f"there is no program {words[0]!r} that can be executed")
    check_positive("timeout", timeout)
    check_count("workers", workers)
    if Path(output).name != output:
        raise ValueError(f"output is the name of a file without a folder; got {output!r}")
    own = [found] if os.path.dirname(words[0]) else []
    form = TraceForm(signals, dt, length, declared_files([*own, *files]))
    made = (os.path.abspath(found) if own else found, *words[1:])
    variables = dict(environment or {})
    return Program(made, output, time, dt, float(timeout), variables, form, workers)


def _wait(process: "subprocess.Popen[bytes]", timeout: float, stopped: threading.Event) -> bool:
    """Wait until a program has ended; return False if its time, or that of the run, was over."""
    left = timeout
    while left > 0 and not stopped.is_set():
        step = min(left, 0.5)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(step)
            return True
        left -= step
    return False


def _said(folder: Path) -> str:
    """Return the end of what a program wrote to its standard error."""
    with open_file(folder / "stderr") as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - 4 * MAX_SAID))
        said = one_line(file.read().decode("utf-8", "replace").strip()[-MAX_SAID:], MAX_SAID)
    return f"; it wrote: {said}" if said else ""


def _by_name(features: Features, prefix: str = "") -> dict[str, Any]:
    """Return features, their parts and entries by the names of a command."""
    found: dict[str, Any] = {}
    for name, value in features.items():
        found[f"{prefix}{name}"] = value
        if isinstance(value, Mapping):
            del found[f"{prefix}{name}"]
            found |= _by_name(value, f"{prefix}{name}.")
        elif len(getattr(value, "shape", ())) == 1:
            found |= {f"{prefix}{name}[{i}]": _entry(value, i) for i in range(value.shape[0])}
    return found


def _entry(value: Any, index: int) -> Any:
    return value[index] if isinstance(value, np.ndarray) else value


def _is_named(feature: str, words: Sequence[str]) -> bool:
    return any(re.split(r"[.\[]", word)[0] == feature for word in words)


def _text(value: Any) -> str:
    """Return a value as an argument; several numbers are joined by commas."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    return ",".join(map(_text, value)) if isinstance(value, list) else str(value)
