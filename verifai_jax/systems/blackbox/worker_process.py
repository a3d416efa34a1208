"""The code of a black box's worker processes, from their start to their end.

The pool of `workers.py` starts them and sends each the name of its function: nothing is unpickled.
"""

import contextlib
import importlib
import importlib.util
import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable
from multiprocessing import spawn
from multiprocessing.connection import Connection
from pathlib import Path

from verifai_jax.core.user_code.forks import returning_once
from verifai_jax.core.user_code.user_errors import format_user_error
from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.systems.base import Features, Outcome

# True in a worker that still imports the simulator.
preparing = False
# What a worker runs. Its path is that of this process, whatever was added since it started.
START = (
    "import sys; sys.path[:] = {path!r}; "
    "from verifai_jax.systems.blackbox import worker_process; worker_process.work({fd})"
)


MARK = "VERIFAI_JAX_WORKER"
"""Variable of a worker's environment, which all processes that it starts inherit."""


def end_marked(mark: str) -> None:
    """End the processes with this mark, or one that begins with it, except for this one."""
    marked, own = f"\0{MARK}={mark}".encode(), str(os.getpid())
    for file in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):
            if marked in b"\0" + file.read_bytes() and file.parent.name != own:
                os.kill(int(file.parent.name), signal.SIGKILL)


def pickled_setup(
    simulation: Callable[[Features, int], Trace], function: Callable[..., object]
) -> bytes:
    """Pickle all that a worker needs to start.

    **Raises:** `ValueError` for a function that another process cannot import.
    """
    name = getattr(function, "__qualname__", None) or repr(function)
    where = "at the top level of a module or a script"
    try:
        pickled = pickle.dumps(simulation)
    except Exception as error:
        if preparing:  # Its module is half imported; and nothing will be simulated here.
            return b""
        raise ValueError(
            f"new processes must be able to import what they run: {name} cannot be ({error}). "
            f"Define it by `def` {where}; a black box may leave out workers"
        ) from error
    main = None
    if b"__main__" in pickled:
        main = {k: v for k, v in spawn.get_preparation_data("").items() if k.startswith("init")}
        file = getattr(sys.modules["__main__"], "__file__", None)
        if not main or ("init_main_from_path" in main and not (file and Path(file).exists())):
            raise ValueError(
                f"a new process cannot import {name} from "
                "a notebook or an interactive session: put it into a file next to the notebook "
                f"(`%%writefile simulator.py`), {where}, and import it from there; a black "
                "box may leave out workers"
            )
    module = getattr(function, "__module__", None) or type(function).__module__
    # Those that are loaded by their file are not found by their name: a target of the command line.
    files = {n: m.__file__ for n, m in sys.modules.items() if n.startswith("_target_")}
    files = {name: file for name, file in files.items() if name.encode() in pickled}
    files.setdefault(module, getattr(sys.modules.get(module), "__file__", None))
    return pickle.dumps((pickled, main, files))


def main_guard() -> str:
    return (
        "a worker process imports the script that started it, and the script starts simulations "
        "when it is imported. Put what it runs under `if __name__ == '__main__':`, or the "
        "simulator into a module of its own"
    )


def work(fd: int) -> None:
    """Simulate the tasks received through the pipe until it closes; runs in a worker process."""
    global preparing
    os.set_inheritable(fd, False)
    pipe = Connection(fd)
    threading.Thread(target=_outlive_no_parent, args=(os.getppid(),), daemon=True).start()
    simulation, problem = None, ""
    preparing = True
    try:
        pickled, main, files = pickle.loads(pipe.recv_bytes())
        if main is not None:
            spawn.prepare(main)
        for module, file in files.items():
            if module not in sys.modules:
                _import(module, file)
        simulation = pickle.loads(pickled)
    except BaseException as error:
        problem = f"a worker process could not import what it runs: {format_user_error(error)}"
        if main_guard() in str(error):
            problem = main_guard()
    preparing = False
    # A run that is gone needs no answer.
    with contextlib.suppress(EOFError, OSError):
        pipe.send(problem)
        if simulation is not None:
            _answer(pipe, simulation)


def _answer(pipe: Connection, simulation: Callable[[Features, int], Trace]) -> None:
    """Simulate task after task."""
    while True:
        number, features, seed = pipe.recv()
        try:
            with returning_once():
                made = simulation(features, seed)
            reply = pickle.dumps((number, Outcome(made)))
        except BaseException as error:  # sys.exit() in a simulator is its failure, not our end.
            failed = Outcome(None, Status.ERROR, format_user_error(error))
            reply = pickle.dumps((number, failed))
        pipe.send_bytes(reply)


def _import(module: str, file: str | None) -> None:
    """Import a module, by its file where only the parent process knows its name."""
    try:
        importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module or file is None:
            raise
        spec = importlib.util.spec_from_file_location(module, file)
        assert spec is not None
        assert spec.loader is not None
        sys.modules[module] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[module])


def _outlive_no_parent(parent: int) -> None:
    """End this process, and those it has started, if its parent is gone."""
    while os.getppid() == parent:
        time.sleep(1.0)
    end_marked(os.environ[MARK])
    os.killpg(os.getpid(), signal.SIGKILL)  # It leads a session, and so a group, of its own.
