"""A falsification problem: its inputs, its system and its property.

    Problem("balance", space={"x0": Box(-1, 1)}, system=simulate, spec="always[0, 4] x <= 2.4")
    Problem("drive", ..., spec={"safe": "always dist > 2", "arrives": "eventually x > 90"})

`Problem.check()` says everything that is wrong with it before anything compiles.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from verifai_jax.core.compute.compilation import ProgramCache, Slot
from verifai_jax.core.compute.fingerprint import fingerprint
from verifai_jax.core.compute.precision import reproducible_settings, truncate_silently
from verifai_jax.core.compute.purity import TRACED_ONCE, Watched, watch
from verifai_jax.core.display.extensions import verb
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.display.notebook import InNotebook, text_html
from verifai_jax.core.messages.checks import check_name
from verifai_jax.core.messages.errors import missing_name
from verifai_jax.core.messages.text import is_control, printable, shorten
from verifai_jax.core.user_code.source_collection import made_here, sources_of
from verifai_jax.core.user_code.sources import Maker, Sources
from verifai_jax.core.user_code.user_errors import (
    check_called_with,
    defined_at,
    explain_user_error,
    user_line,
)
from verifai_jax.core.values.trace import Trace
from verifai_jax.features import Domain, FeatureSpace
from verifai_jax.mtl import Formula, hard, parse, robustness
from verifai_jax.mtl.deciding import leaves_of
from verifai_jax.mtl.evaluate import End
from verifai_jax.mtl.requirements import Requirement
from verifai_jax.mtl.semantics import Semantics
from verifai_jax.problem.behaviour import Behaviour
from verifai_jax.problem.guide import Guide, Term
from verifai_jax.problem.rulebook import Rulebook
from verifai_jax.problem.tracing import traced, traced_by_default, why_not_batched
from verifai_jax.systems.base import System, as_system

ORDER = "; the order is Problem(name, space, system, spec)"


class ProblemError(ValueError):
    """An error for parts of a problem that do not fit together."""


@dataclass(frozen=True, eq=False)
class Problem(InNotebook):
    """A feature space, a system and the properties it must keep, under a name.

    **Arguments:**
    - `name`: the name on the command line and in reports.
    - `space`: a `FeatureSpace`, or a dictionary of domains.
    - `system`: any function `(features, key) -> Trace`, pure and traceable by JAX, or a `System`;
      stored as a `System`.
    - `spec`: a formula (text or `Formula`), or several by name; the overall robustness of a
      simulation is the least of them.
    - `nominal`: the features of normal operation; must lie in the space.
    - `description`: one line for `verifai-jax list`.
    - `end`: what a formula sees after the end of a trace; `"hold"` repeats the last sample.
    - `priority`: which of several formulas matter more: names in falling order, or pairs `(higher,
      lower)` of a graph (`rulebook.Rulebook`). A search then looks for the gravest counterexamples,
      not for the least robustness.
    - `behaviour`: how traces are classified (`Behaviour`), for a search guided by coverage.
    - `guide`: a term that steers searches in addition to the robustness and never decides a
      verdict: a formula, its text, a function of the trace and the features, or a `Guide` with its
      weight.
    - `draw`: a function `(axes, trace, sample, features)` that draws one frame of an animation.
    - `requirements`: the requirements that the formulas formalise: a file (`mtl.read_requirements`)
      or requirement objects. A formula belongs to the requirement whose identifier is its name. See
      `trace_matrix`.
    - `made_in`: the modules whose code defines the problem, recorded with its runs. By default the
      modules on the call stack, or those of the problem from which this one was derived.
    - `target`: the name `FILE.py:NAME` of the problem on the command line, recorded with its runs.
      Workers of an executor that cannot pickle the problem load it by this name.

    `formulas` holds the parsed spec by name; `rulebook` the order of the formulas, None without a
    priority; `programs` the programs compiled for this problem.

    **Raises:** `ValueError` for an empty name or spec, a formula that does not parse, nominal
    features outside the space, or a priority that has a cycle or names no formula.
    """

    _internal = frozenset((
        "black_box", "draws", "form", "made_in", "monitored", "on_backend",
        "programs", "requirement_entries", "sources", "traced",
    ))  # fmt: skip
    name: str
    space: FeatureSpace
    system: System
    spec: Formula | str | Mapping[str, Formula | str]
    nominal: Mapping[str, Any] | None
    description: str
    end: End
    draw: Callable[..., None] | None
    priority: Sequence[str] | Sequence[tuple[str, str]] | None
    behaviour: Behaviour | None
    guide: Guide | None
    requirements: tuple[Requirement, ...]
    made_in: Sequence[Maker] | None = field(repr=False)
    target: str | None = field(repr=False)
    formulas: Mapping[str, Formula] = field(init=False, repr=False)
    rulebook: Rulebook | None = field(init=False, repr=False)
    programs: ProgramCache = field(init=False, repr=False)

    def __init__(
        self,
        name: str,
        space: FeatureSpace | Mapping[str, Domain],
        system: System | Callable[..., Trace],
        spec: Formula | str | Mapping[str, Formula | str],
        nominal: Mapping[str, Any] | None = None,
        description: str = "",
        end: End = "hold",
        draw: Callable[..., None] | None = None,
        priority: Sequence[str] | Sequence[tuple[str, str]] | None = None,
        behaviour: Behaviour | None = None,
        guide: Guide | Formula | str | Term | None = None,
        requirements: str | Path | Iterable[Requirement] | None = None,
        made_in: Sequence[Maker] | None = None,
        target: str | None = None,
    ) -> None:
        if not isinstance(name, str) or not name.strip():
            raise ProblemError(f"a problem needs a name; got {shorten(repr(name))}{ORDER}")
        check_name("the name of a problem", name, lines=True, error=ProblemError)
        # It is for people, and no part of the model refers to it.
        name = "".join("_" if is_control(character) else character for character in name)
        if isinstance(space, Mapping):
            space = FeatureSpace(space)
        if not isinstance(space, FeatureSpace):
            raise ProblemError(
                "space must be a FeatureSpace or a dictionary of domains; got "
                f"{shorten(repr(space))}{ORDER}"
            )
        if not callable(system):
            raise ProblemError(
                f"system must be a function (features, key) -> Trace; got {system!r}{ORDER}"
            )
        named = spec if isinstance(spec, Mapping) else {"spec": spec}
        if not named:
            raise ProblemError("spec has no formula; give a formula or a dictionary of them")
        for key in named:
            check_name("the name of a formula", key, error=ProblemError)
        formulas = {name: _formula(name, formula) for name, formula in named.items()}
        values = {
            "name": name,
            "space": space,
            "system": as_system(system).with_domains(space.domains),
            "spec": spec,
            "nominal": nominal,
            "description": printable(str(description)),
            "end": end,
            "draw": draw,
            "priority": priority,
            "behaviour": behaviour,
            "guide": guide if guide is None or isinstance(guide, Guide) else Guide(guide),
            "requirements": _requirements(requirements),
            "made_in": made_here() if made_in is None else tuple(made_in),
            "target": target,
            "formulas": formulas,
            "rulebook": None if priority is None else _rulebook(priority, formulas),
            "programs": ProgramCache(),
        }
        for attribute, value in values.items():
            object.__setattr__(self, attribute, value)
        check_called_with("draw", draw, ("axes", "trace", "sample", "features"))
        if nominal is not None:
            space.check(nominal)

    @property
    def monitored(self) -> tuple[str, ...]:
        """Names of the signals that the formulas use."""
        return tuple(dict.fromkeys(n for f in self.formulas.values() for n in f.signals()))

    @property
    def black_box(self) -> bool:
        """True if the system runs on the host, where JAX cannot trace it."""
        return self.system.black_box

    def sources(self, first: int = 0, git: bool = True) -> Sources:
        """Return the files that define the problem, with hashes, and versions of libraries.

        **Arguments:**
        - `first`: the first row of the table to which they apply.
        - `git`: whether git is asked for the commit, which a comparison of files does not need.
        """
        program = self.programs.get(FINGERPRINT, None, self._fingerprint)
        return sources_of(self, made=self.made_in or (), first=first, program=program, git=git)

    def requirement_entries(self) -> dict[str, dict[str, str]]:
        """Return the content of the formulas' requirements, by identifier, as plain data."""
        return {each.id: each.entry() for each in self.requirements if each.id in self.formulas}

    @reproducible_settings()
    def _fingerprint(self) -> str:
        """Return a hash of the system's program; empty where there is none to take."""
        if self.black_box or not traced_by_default(self.system):
            return ""
        try:
            return fingerprint(self.traced()[0], derivatives=False) or ""
        except Exception:
            return ""  # What it raises, `check` says.

    def traced(self) -> tuple[Any, Trace]:
        """Return the system's program, of features and a key, and the form of its traces.

        It is traced once for each precision.

        **Raises:** the errors of the system.
        """
        make = lambda: traced(self.system, self.space.feature_form)  # noqa: E731
        return self.programs.get(TRACED, _settings(), make)

    def draws(self) -> bool:
        """Return whether the system uses its random key; abstract evaluation, nothing compiles.

        JAX draws different numbers in float64 than in float32, so a replay of such a system is the
        same simulation only in the precision of its run. A black box gets an integer seed.
        """
        if self.black_box:
            return False
        program = self.traced()[0].jaxpr
        return any(program.invars[-1] is used for step in program.eqns for used in step.invars)

    def __getstate__(self) -> dict[str, Any]:
        # What is compiled for it stays here: another process compiles its own.
        return {**self.__dict__, "programs": ProgramCache()}

    def on_backend(self, backend: str) -> "Problem":
        """Return the same problem on one backend of its system; repeated calls return one object.

        Returns this problem if its system has no backends, or uses this one already.

        **Raises:** the error of the system's `with_backend` for a backend that it lacks.
        """
        system = self.system
        if not system.backends or system.backend == backend:
            return self
        return self.programs.get(
            BACKENDS, backend, lambda: replace(self, system=system.with_backend(backend))
        )

    def only(self, *features: str, nominal: Mapping[str, Any] | None = None) -> "Problem":
        """Return the same problem with only these features varied, the others at nominal values.

        - `nominal`: values for the fixed features, where they differ from the problem's own.

        **Raises:** `ValueError` for an unknown feature, or a fixed one without a nominal value.
        """
        fixed = {**(self.nominal or {}), **(nominal or {})}
        own = None if self.nominal is None else fixed
        return replace(self, space=self.space.only(*features, nominal=fixed), nominal=own)

    def with_faults(self, *faults: object, by_simulator: bool = False) -> "Problem":
        """Return the same problem with faults of its sensors and actuators among its features.

        **Arguments:**
        - `faults`: the faults of `vj.faults`; those of one channel apply in this order. The varying
          numbers of a fault become a feature with the fault's name, whose nominal value is the
          weakest, shortest and latest fault.
        - `by_simulator`: whether the simulator applies the faults itself, for which
          `vj.faults.on_host` helps; for `remote`, and for your own `blackbox`.
        **Raises:** `UnknownNameError` for a channel that the system does not have, with the nearest
        one; `ValueError` for a name that exists already, a fault that a channel cannot have, and a
        system whose loop is not known.
        """
        function = verb("faults")
        return function(self, faults, by_simulator)

    def objective(
        self, semantics: Semantics = hard, of: str = "unit", key: Key[Array, ""] | None = None,
        formula: str | None = None,
    ) -> Callable[..., Float[Array, ""]]:  # fmt: skip
        """Return the robustness of one simulation as a pure function, for JAX to transform.

        `jax.grad(problem.objective(mtl.smooth(0.1)))(u)` is its gradient at a point of the unit
        cube; `jax.vmap` and `jax.jit` work as usual.

        **Arguments:**
        - `semantics`: `mtl.hard`, the margin of the verdict, or `mtl.smooth(temperature)`.
        - `of`: the argument of the function: `"unit"`, a point `[dim]` of the unit cube, or
          `"features"`, a dictionary by name.
        - `key`: random key of the simulation; `jax.random.key(0)` when left out.
        - `formula`: name of the formula to evaluate; by default the least robustness over all.
        **Returns:** a function `(point, key=key)` to a scalar: positive where the property holds,
        NaN where the simulation has no verdict. It does not check that a point lies in its domains
        and keeps the constraint of the space.
        **Raises:** `ProblemError` for a system that JAX does not trace; `UnknownNameError` for an
        `of` or a formula that does not exist; the errors of `check`.
        """
        function = lazy_import("verifai_jax.evaluation.objective", "objective")
        return function(self, semantics, of, key, formula)

    @truncate_silently()
    def check(self) -> None:
        """Trace the system and its monitor abstractly; nothing is simulated or compiled.

        A system may define its own `check(features)`, with features as `jax.ShapeDtypeStruct`s, and
        `abstract(features)`, which returns the shapes of its traces if JAX cannot trace it quickly.

        **Raises:** the errors of the system's own check; `ProblemError` for a system that raises or
        returns no `Trace`; the monitor's error for a formula over a signal that the system does not
        produce.
        """
        features = self.space.feature_form
        try:
            self.system.check(features)
        except ValueError:
            raise
        except Exception as error:
            raise self._wrong_system(error, features) from error
        trace = self.form()
        if trace is None:
            self._check_known()
            return

        def judged(trace: Trace, features: Any) -> Any:
            values = [robustness(f, trace, end=self.end) for f in self.formulas.values()]
            guide, where = self.guide, self.space.where
            steered = None if guide is None else guide.value(trace.hold(), features, self.end)
            return values, steered, None if where is None else where(features)

        judges = (tuple(self.formulas.values()), self.guide, self.space.where)
        program = lambda: jax.make_jaxpr(lambda *a: judged(*a))(trace, features)  # noqa: E731
        watched = lambda: watch(judges, program, twice=False).why_impure  # noqa: E731
        if why_impure := self.programs.get(JUDGED, _settings(), watched):
            raise ProblemError(
                f"what judges the simulations of problem {self.name!r} {why_impure}. "
                f"{TRACED_ONCE}: a formula, a guide and a constraint are functions of their "
                "arguments alone"
            )

    def _check_known(self) -> None:
        """Check the formulas against what is known of the signals of a black box."""
        known = self.system.known_signals
        for signal in self.monitored:
            if known is not None and signal not in known:
                raise missing_name("the trace", "signal", signal, known)
        if isinstance(known, Mapping):
            shapes = {name: (2,) if width == 1 else (2, width) for name, width in known.items()}
            forms: Any = {n: jax.ShapeDtypeStruct(s, np.float32) for n, s in shapes.items()}
            # Predicates alone: how long a trace lasts, and how often it is sampled, is not known.
            for leaf in leaves_of(list(self.formulas.values())):
                jax.eval_shape(lambda t, f=leaf: robustness(f, t), Trace(forms, dt=1.0))

    def form(self) -> Trace | None:
        """Return the shapes of the system's traces, signals as `jax.ShapeDtypeStruct`; traced once.

        None if only a simulation can show them.

        **Raises:** `ProblemError` for a system that raises, or returns no `Trace`.
        """
        return self.programs.get(FORM, None, self._form)

    @property
    def duration(self) -> float | None:
        """Duration of a whole trace in seconds; None if only a simulation can show it."""
        form = self.form()
        return None if form is None or form.dt is None else (form.length - 1) * form.dt

    @truncate_silently()
    def _form(self) -> Trace | None:
        features, watched = self.space.feature_form, None
        try:
            if self.black_box or not traced_by_default(self.system):
                trace = self.system.abstract(features)
            else:
                watched = watch(self.system, lambda: traced(self.system, features))
                trace = watched.result[1]
        except Exception as error:
            raise self._wrong_system(error, features) from error
        if trace is None and self.black_box:
            return None
        if watched is not None and watched.why_impure:
            raise ProblemError(
                f"the system of problem {self.name!r} {watched.remedy}; or make the system a "
                "vj.blackbox, which JAX does not trace"
            )
        if not isinstance(trace, Trace):
            function = getattr(self.system, "__wrapped__", self.system)
            raise ProblemError(
                f"the system of problem {self.name!r} must return a Trace; "
                f"it returned {type(trace).__name__}{defined_at(function)}"
            )
        if watched is None:
            return trace
        self.programs.get(TRACED, _settings(), lambda: watched.result)
        self.programs.get(WATCHED, None, lambda: watched)
        if (alone := why_not_batched(watched.result[0].jaxpr)) is not None:
            raise ProblemError(
                f"the system of problem {self.name!r} cannot be simulated in batches: {alone}"
            )
        return trace

    def _wrong_system(self, error: Exception, features: Mapping[str, Any]) -> ProblemError:
        native = "native" in self.system.backends and self.system.backend != "native"
        why = explain_user_error(error, features, native=native)
        if isinstance(error, TypeError) and "positional arg" in why and user_line(error) is None:
            function = getattr(self.system, "__wrapped__", self.system)
            why += f"; a system is called with (features, key){defined_at(function)}"
        return ProblemError(f"the system of problem {self.name!r} cannot be simulated: {why}")

    def _repr_html_(self) -> str:
        title = f"{self.name}: {self.description}" if self.description else self.name
        rows = (f"<p>{escape(n)}: {f._repr_html_()}</p>" for n, f in self.formulas.items())
        return "\n".join([text_html(title), *rows, self.space._repr_html_()])

    def __str__(self) -> str:
        lines = [f"{self.name}: {self.description}" if self.description else self.name]
        for name, formula in self.formulas.items():
            lines.append(f"  {name}: {formula}")
        lines.append(f"  features: {', '.join(self.space.columns)}")
        return "\n".join(lines)


JUDGED: Slot[tuple[str, ...], str | None] = Slot("judged")
"""Why formulas, guide and constraint are impure, by JAX's settings; None if they are not."""
FORM: Slot[None, Trace | None] = Slot("form")
"""The form of the traces of a problem's system."""
WATCHED: Slot[None, Watched] = Slot("watched")
"""What was seen when a problem's system was traced first."""
TRACED: Slot[tuple[str, ...], tuple[Any, Trace]] = Slot("traced")
"""The program of the system and the form of its traces, by JAX's precision and generator."""
FINGERPRINT: Slot[None, str] = Slot("fingerprint")
"""The fingerprint of the system's program."""
BACKENDS: Slot[str, Problem] = Slot("backends")
"""The same problem on each backend of its system."""


def _settings() -> tuple[str, ...]:
    names = ("jax_enable_x64", "jax_default_prng_impl")
    return tuple(str(getattr(jax.config, name, None)) for name in names)


def _rulebook(
    priority: Sequence[str] | Sequence[tuple[str, str]], formulas: Mapping[str, Formula]
) -> Rulebook:
    entries: list[Any] = [priority] if isinstance(priority, str) else list(priority)
    if all(isinstance(entry, str) for entry in entries):
        return Rulebook(formulas, list(pairwise(entries)))
    return Rulebook(formulas, entries)


def _requirements(given: str | Path | Iterable[Requirement] | None) -> tuple[Requirement, ...]:
    if isinstance(given, str | Path):
        return verb("requirements")(given, need_formulas=False)
    found = tuple(given or ())
    if other := next((each for each in found if not isinstance(each, Requirement)), None):
        raise ProblemError(
            f"requirements must be a file or Requirements from mtl.read_requirements; got {other!r}"
        )
    return found


def _formula(name: str, formula: Formula | str) -> Formula:
    if isinstance(formula, str):
        return parse(formula)
    if isinstance(formula, Formula):
        return formula
    raise ProblemError(
        f"spec {name!r} must be a formula or its text; got {type(formula).__name__} {formula!r}"
    )
