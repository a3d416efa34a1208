"""An FMU as a system: parameters and start values from features, inputs, controllers, outputs.

    system = vj.fmu("suspension.fmu", duration=4.0, dt=0.01)
    system = vj.fmu("plant.fmu", duration=4.0, dt=0.01, controller=control, workers=4)
    ranges = vj.fmu_ranges("suspension.fmu", ["m", "k"])    # for vj.Box(*ranges["m"])

Each simulation runs in a worker process, which keeps its instance of the FMU for the next one. An
FMU that crashes ends only its worker and costs one row.
"""

import atexit
import shutil
import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from verifai_jax.addons.simulators.fmu.description import Description, Variable, read_description
from verifai_jax.addons.simulators.fmu.exchange import ExchangeInstance
from verifai_jax.addons.simulators.fmu.library import FMUError, Instance
from verifai_jax.core.messages.checks import check_positive, is_number
from verifai_jax.core.messages.errors import missing_name, suggests_options
from verifai_jax.core.store.foreign_archives import open_archive
from verifai_jax.core.values.trace import Trace
from verifai_jax.core.values.waveform import is_waveform
from verifai_jax.features import Domain
from verifai_jax.systems.base import Features, System
from verifai_jax.systems.blackbox._blackbox import blackbox
from verifai_jax.systems.clock import count_periods

if TYPE_CHECKING:
    import pandas as pd
Controller: TypeAlias = Callable[[float, dict[str, float], Features], Mapping[str, float]]
"""From time, outputs by name and features to inputs by name."""
_instances: dict[tuple[Path, bool, str], Instance] = {}
"""Instances of this process, which the next simulation resets and uses again."""


@dataclass(frozen=True, eq=False)
class FMUSimulation:
    """A function that simulates an FMU once; see `fmu` for the fields."""

    file: Path
    duration: float
    dt: float
    bind: Mapping[str, str]
    outputs: Mapping[str, str]
    controller: Controller | None
    reuse: bool
    description: Description = field(repr=False)
    domains: Mapping[str, Domain] = field(default_factory=dict)
    """The domains of those features that are choices, or have two ends."""
    exact_step = True
    """The steps belong to the FMU and its controller."""

    @property
    def __name__(self) -> str:
        return f"the FMU {self.file.name}"

    @property
    def known_signals(self) -> dict[str, int]:
        """The signals of every trace."""
        return dict.fromkeys(self.outputs, 1)

    def check(self, features: Features) -> None:
        """Check that there is a variable for every feature, which can have its values.

        **Raises:** `ValueError` with the first feature for which there is none, and the existing
        variables; the errors of `Variable.number`.
        """
        for name in features:
            variable = self._variable(name)
            if variable is None:
                settable = [v.name for v in self.description.variables.values() if v.settable]
                raise missing_name(
                    f"the FMU {self.file.name}", "parameter, start value or input",
                    self.bind.get(name, name), settable,
                )  # fmt: skip
            if variable:
                self._check_values(name, self.description.variable(variable), features[name])
        for name in self.bind:
            if name not in features:
                raise missing_name("the feature space", "feature", name, list(features))

    def _check_values(self, name: str, variable: Variable, form: PyTree) -> None:
        """Check that a variable can have the values of a feature of this form."""
        what = f"feature {name!r} sets {variable.name} of the FMU {self.file.name}"
        moving = is_waveform(form)
        (leaf, *more), shape = jax.tree.leaves(form), (1,) if moving else ()
        if more or np.shape(leaf)[moving:] != ():
            raise ValueError(f"{what}, which is one number; the feature has {shape or 'several'}")
        domain = self.domains.get(name)
        real = jnp.issubdtype(leaf.dtype, jnp.floating) and not hasattr(domain, "choices")
        if real and not variable.real:
            raise ValueError(
                f"{what}, which is of type {variable.type}, by real values: give whole ones, by "
                "vj.DiscreteBox or vj.Categorical"
            )
        for value in _extremes(domain, listed=bool(variable.items)):
            try:
                variable.number(value)
            except ValueError as error:
                raise type(error)(f"{what}: {error}") from None

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on features with values beyond the ranges that the FMU declares."""
        found = []
        for name, domain in self.domains.items():
            variable = self.description.variables[self._variable(name) or ""]
            values = [variable.number(value) for value in _extremes(domain)]
            if min(values) < variable.low or max(values) > variable.high:
                found.append(
                    f"feature {name!r} has values from {min(values):zg} to {max(values):zg}; the "
                    f"FMU declares {variable.name} from {variable.low:zg} to {variable.high:zg}"
                )
        return tuple(found)

    def with_domains(self, domains: Mapping[str, Domain]) -> "FMUSimulation":
        """Return the same simulation for features of these domains."""
        known = dict(self.domains)
        for name, domain in domains.items():
            while isinstance(inner := getattr(domain, "domain", None), Domain):
                domain = inner  # Of a Signal, or of one that is held at a value.
            if self._variable(name) and _extremes(domain):
                known[name] = domain
        return self if known == self.domains else replace(self, domains=known)

    def __call__(self, features: Features) -> Trace:
        constant, moving = {}, {}
        for name, value in features.items():
            variable = self._variable(name)
            if not variable:
                continue
            if is_waveform(value):
                course = value if value.duration or value.times else value.over(self.duration)
                moving[variable] = partial(self._value, name, course)
            else:
                constant[variable] = self._value(name, lambda _, value=value: value, 0.0)
        instance, only_once = self._instance(), self.description.only_once
        try:
            trace = self._simulated(instance, constant, moving, features)
        except BaseException:
            # An instance that failed is in no state to be used again, nor to be given back.
            instance.failed = True
            if not only_once:
                _instances.pop(self._key, None)
            raise
        # Some that ended their simulation still think so when they are reset.
        doubtful = trace.valid is not None and not instance.new_state
        if not only_once and (doubtful or not self.reuse):
            _instances.pop(self._key).free()
        return trace

    def _simulated(
        self, instance: Instance, constant: dict[str, Any], moving: dict[str, Any], given: Features
    ) -> Trace:
        steps = count_periods(self.duration, self.dt, "duration")
        names = tuple(self.outputs.values())

        def at(time: float) -> dict[str, Any]:
            return {name: course(time) for name, course in moving.items()}

        # The last step ends where the simulation does, which a strict FMU compares to the bit.
        before = (steps - 1) * self.dt
        end = self.duration if self.description.varies_step else before + self.dt
        instance.begin({**constant, **at(0.0)}, end)
        rows = [instance.get(names)]
        for step in range(steps):
            time = step * self.dt
            inputs = at(time) if moving else {}
            if self.controller is not None:
                seen = dict(zip(self.outputs, rows[step], strict=True))
                inputs.update(self.controller(time, seen, given))
            if inputs:
                instance.set(inputs)
            last = step == steps - 1 and self.description.varies_step
            if not instance.step(time, end - time if last else self.dt):
                break
            rows.append(instance.get(names))
        valid = len(rows)
        table = np.array(rows + rows[-1:] * (steps + 1 - valid))
        signals = {name: table[:, i] for i, name in enumerate(self.outputs)}
        return Trace(signals, dt=self.dt, valid=None if valid > steps else np.int32(valid))

    def _value(self, feature: str, course: Callable[[float], Any], time: float) -> Any:
        """Return a feature at a time; of a choice that is no number the choice itself."""
        value, domain = course(time), self.domains.get(feature)
        choices = getattr(domain, "choices", None)
        if isinstance(value, str) or choices is None or (domain and domain.numeric):
            return value
        return choices[int(value)]

    def _variable(self, feature: str) -> str | None:
        """Return the variable that a feature sets; None for one that only the controller sees."""
        name = self.bind.get(feature, feature)
        found = self.description.variables.get(name)
        if found is None or not found.settable:
            return "" if self.controller is not None and feature not in self.bind else None
        return name

    def _instance(self) -> Instance:
        if self._key not in _instances:
            if self.description.only_once and any(key[0] == self.file for key in _instances):
                raise FMUError(
                    f"a process can only have one instance of {self.file.name}, and this process "
                    "already has one; simulate each system in its own process with workers=1"
                )
            folder = Path(tempfile.mkdtemp(prefix="verifai_jax_fmu_"))
            atexit.register(shutil.rmtree, folder, ignore_errors=True)
            open_archive(self.file, self.file.name).extractall(folder)
            kind = ExchangeInstance if self.description.exchange else Instance
            _instances[self._key] = kind(self.description, folder)
        return _instances[self._key]

    @property
    def _key(self) -> tuple[Path, bool, str]:
        # The token is another one for a model that was exported again under the same name.
        return self.file, self.description.exchange, self.description.token


def _extremes(domain: Domain | None, listed: bool = False) -> tuple[Any, ...]:
    """Return the choices of a domain, or its ends; with `listed` all whole numbers between them."""
    if (choices := getattr(domain, "choices", None)) is not None:
        return choices
    low, high = getattr(domain, "low", None), getattr(domain, "high", None)
    if not (is_number(low) and is_number(high)):
        return ()
    return tuple(range(int(low), int(high) + 1)) if listed else (low, high)


@suggests_options
def fmu(
    file: str | Path,
    *,
    duration: float,
    dt: float,
    bind: Mapping[str, str] | None = None,
    outputs: Iterable[str] | Mapping[str, str] | None = None,
    controller: Controller | None = None,
    workers: int | None = 1,
    timeout: float | None = None,
    reuse: bool = True,
    exchange: bool | None = None,
) -> System:
    """Make a system from a Functional Mock-up Unit: FMI 2 or 3, co-simulation or model exchange.

    A feature sets the variable with its name before each simulation: a parameter, a start value, or
    an input; a `Signal` is an input over time. The choices of a feature for an enumeration are the
    names of its items. An FMU is an executable program: simulate only those
    that you trust.

    **Arguments:**
    - `file`: the FMU.
    - `duration`: duration of a simulation in seconds, a multiple of `dt`.
    - `dt`: seconds between two samples, which is also the communication step.
    - `bind`: a dictionary from features to variables, if their names differ.
    - `outputs`: variables that are signals of the trace: a list of names, or a dictionary from
      signals to variables; by default those of causality `output`, with `_` for characters that
      names may not have.
    - `controller`: a function `(time, outputs, features)` that returns inputs by the variables'
      names, called once a step; features that are not variables are passed only to it.
    - `workers`: number of processes; None for this process, which a crash of the FMU would end.
    - `timeout`: seconds after which a simulation is aborted.
    - `reuse`: whether a process reuses its instance for the next simulation, which saves loading
      it. The instance is set back to its initial state, or reset if the FMU cannot save its state.
      Use False for an FMU whose reset is incomplete.
    - `exchange`: whether to integrate its equations here, by model exchange; by default only for an
      FMU without its own solver.
    **Returns:** the system.
    **Raises:** `FileNotFoundError`; `ValueError` for a file that is not such an FMU, or has no
    binary for this machine, for variables that do not exist, and times out of range.
    """
    duration, dt = check_positive("duration", duration), check_positive("dt", dt)
    steps = count_periods(duration, dt, "duration")
    description = read_description(file, exchange)
    if description.only_once and not reuse:
        only = f"a process can only have one instance of the FMU {description.file.name}"
        raise ValueError(f"{only}; leave out reuse=False")
    _ = description.binary
    if outputs is None:
        there = [v for v in description.variables.values() if v.causality == "output"]
        outputs = [v.name for v in there if v.scalar and v.type != "String"]
    named = dict(outputs if isinstance(outputs, Mapping) else {_identifier(n): n for n in outputs})
    if not named:
        some = ", ".join(list(description.variables)[:5])
        raise ValueError(
            f"the FMU {description.file.name} has no output; name variables by outputs=..., such "
            f"as {some}"
        )
    for name in (*named.values(), *(bind or {}).values()):
        description.variable(name)
    simulation = FMUSimulation(
        description.file, duration, dt, dict(bind or {}), named, controller, reuse, description
    )
    form = {"signals": tuple(named), "dt": dt, "length": steps + 1}
    files = [description.file]
    return blackbox(simulation, workers=workers, timeout=timeout, files=files, **form)


def fmu_variables(file: str | Path) -> "pd.DataFrame":
    """List the variables of an FMU: causality, variability, type, unit, start value and range.

    **Raises:** the errors of `fmu`.
    """
    import pandas as pd

    columns = ("name", "causality", "variability", "type", "unit", "start", "low", "high",
               "description")  # fmt: skip
    rows = [[getattr(v, c) for c in columns] for v in read_description(file).variables.values()]
    return pd.DataFrame(rows, columns=list(columns)).set_index("name")


def fmu_ranges(
    file: str | Path, names: Iterable[str], around: float | None = None
) -> dict[str, tuple[float, float]]:
    """Return the ranges that an FMU declares for variables, as ends of `Box(low, high)`.

    **Arguments:**
    - `file`: the FMU.
    - `names`: names of parameters, start values or inputs.
    - `around`: relative deviation from the start value, such as 0.2, that is used as the range of
      variables without one.
    **Returns:** the low and the high end for each name.
    **Raises:** `ValueError` for a variable without a range, unless `around` is given and it has a
    start value; the errors of `fmu`.
    """
    description, ranges = read_description(file), {}
    for name in names:
        variable = description.variable(name)
        low, high = variable.low, variable.high
        if not np.isfinite([low, high]).all():
            if around is None or variable.start is None or not variable.real:
                raise ValueError(
                    f"{name} of the FMU {description.file.name} declares no finite range ({low:zg} "
                    f"to {high:zg}), but the start value {variable.start}; give around=0.2 for a "
                    "range of 20 % to both sides, or write its domain"
                )
            start = float(variable.start)
            reach = around * abs(start)
            low, high = max(low, start - reach), min(high, start + reach)
        ranges[name] = (low, high)
    return ranges


def _identifier(name: str) -> str:
    """Return a name that formulas can use for a variable."""
    made = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in name)
    return made if made[:1].isalpha() or made[:1] == "_" else f"_{made}"
