"""Faults in the loop of a system, as links that observations or actions pass through."""

import operator
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import starmap
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PyTree

from verifai_jax.addons.faults.fault import AtMost, Fault, FaultFeatures, Moment, slack
from verifai_jax.addons.faults.kinds import WrongChannel
from verifai_jax.core.compute.keys import mixed_bits
from verifai_jax.core.messages.errors import check_names
from verifai_jax.features import FeatureSpace
from verifai_jax.problem.problem import Problem
from verifai_jax.systems.any_lane import changed_if_needed
from verifai_jax.systems.channels import Channels, Entries, Instant, Link, Passing, Side


@dataclass(frozen=True)
class Injected(Link):
    """A fault at its channel, in the loop of a system; `inject` makes it.

    - `entries`: indices of the channel's entries; `other`: indices of the entries that replace them
      in `WrongChannel`.
    - `choice`: the feature of `AtMost` that decides whether the fault happens, and the fault's
      number in it.
    """

    fault: Fault
    entries: Entries
    other: Entries | None
    choice: tuple[str, int] | None

    @property
    def side(self) -> Side:
        return self.entries.side

    @property
    def draws(self) -> bool:
        return self.fault.draws

    @property
    def features(self) -> tuple[str, ...]:
        own = (self.fault.name,) if self.fault.domains else ()
        return own if self.choice is None else (*own, self.choice[0])

    @property
    def arrays(self) -> tuple[str, ...]:
        both = [each for each in (self.entries, self.other) if each is not None]
        return tuple(n for e in both if e.side == "observation" for n in e.names if n)

    def check(self, features: PyTree) -> None:
        check_names("feature", self.features, features)

    def valid(self, features: PyTree) -> Any:
        numbers = [(name, features[self.fault.name][name]) for name in self.fault.domains]
        return reduce(operator.and_, starmap(_can_be, numbers), True)

    def refusal(self, features: PyTree, owner: str) -> str | None:
        for name in self.fault.domains:
            # Of a table, whose columns have the names of both, or of a simulation.
            column, whole = f"{self.fault.name}.{name}", features.get(self.fault.name)
            number = features.get(column) if whole is None else whole[name]
            if number is not None and not _can_be(name, number):
                wanted = f"a number{', 0 or more' * (name == 'duration')}; got {number}"
                return f"{name} of fault {self.fault.name!r} of {owner} must be {wanted}"
        return None

    def begin(self, value: PyTree, now: Instant, key: Key[Array, ""] | int | None) -> PyTree:
        host, number = now.xp is np, zlib.crc32(self.fault.name.encode())
        good = np.zeros(self.entries.count) if host else self.entries.take(value, jnp)
        memory = self.fault.memory(now.xp.zeros_like(good), now.period)
        if not self.draws:
            return None, memory
        if host:
            return np.array([int(key or 0), number], np.uint32), memory
        key = jax.random.key(0) if key is None else key
        return jax.random.key_data(jax.random.fold_in(key, number))[-2:], memory

    def through(self, state: PyTree, value: PyTree, now: Instant) -> tuple[PyTree, PyTree]:
        xp, (seed, memory), possible = now.xp, state, self._happens(now.features)
        drawn = now.features[self.fault.name] if self.fault.domains else {}
        number = {**self.fault.numbers, **drawn}
        other = None if self.other is None else self.other.take(value, xp)
        leaves, form = jax.tree.flatten(value)
        parts = [xp.asarray(leaves[i]) for i, _ in self.entries.parts]
        given = now.time, now.ended, possible, number, seed, other
        passing, change = (parts, memory), partial(self._faulty, now)
        if xp is not np:
            needed = jnp.asarray(possible & self._severe(number))
            change = partial(changed_if_needed, change, needed)
        parts, memory = change(passing, given)
        for (i, _), part in zip(self.entries.parts, parts, strict=True):
            leaves[i] = part
        return jax.tree.unflatten(form, leaves), (seed, memory)

    def _severe(self, number: Mapping[str, Any]) -> Any:
        """Return whether the fault acts at any time."""
        off = {self.fault.severity: self.fault.off, "duration": 0.0}
        differs = (number[name] != off[name] for name in off if name in number)
        return reduce(operator.and_, differs, np.bool_(True))

    def _faulty(
        self, now: Instant, passing: tuple[list[Any], PyTree], given: tuple[Any, ...]
    ) -> tuple[list[Any], PyTree]:
        """Return the parts of a value with the fault applied, and the new memory of the fault."""
        xp, (parts, memory), (time, ended, possible, number, seed, other) = now.xp, passing, given
        within = self.entries._replace(
            parts=tuple((i, index) for i, (_, index) in enumerate(self.entries.parts))
        )
        good, now = within.take(parts, xp), now._replace(time=time, ended=ended)
        since = time - number["onset"]
        lead = since / now.period
        # A fault that never ends has ended in no sample, and its end moves nothing.
        trail = (since - number["duration"]) / now.period if "duration" in number else -2.0
        early = -slack(time, now.period)
        live = possible & (lead >= early) & (trail < early)
        on = live & self._severe(number)
        at = Moment(
            xp, number, live, xp.maximum(since, 0.0), time, now.period, now.step == 0,
            self.side == "action", other, lambda count: _uniform(seed, now.step, count, xp),
        )  # fmt: skip
        bad, after = self.fault.corrupt(good, memory, at)
        if xp is not np:
            after = jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), after, memory)
        bad = xp.broadcast_to(xp.asarray(bad), good.shape).astype(good.dtype)
        if xp is np or self.entries.whole:
            faulty = xp.where(on, bad, good)
        else:
            edges = (jnp.asarray(edge, good.dtype) for edge in (lead, trail))
            faulty = _blend(on, live, jnp.asarray(possible), *edges, bad, good)
        return within.put(parts, faulty, xp), now.kept(memory, after)

    def _happens(self, features: PyTree) -> Any:
        if self.choice is None:
            return np.bool_(True)
        chosen = (each == self.choice[1] for each in features[self.choice[0]].values())
        return reduce(operator.or_, chosen, np.bool_(False))


def _can_be(name: str, number: Any) -> Any:
    """Return whether a number of a fault is allowed: finite, and a duration not negative."""
    finite = abs(number) < np.inf
    return finite & (number >= 0) if name == "duration" else finite


@jax.custom_jvp
def _blend(
    on: Bool[Array, ""], live: Bool[Array, ""], possible: Bool[Array, ""], lead: Float[Array, ""],
    trail: Float[Array, ""], bad: Float[Array, " n"], good: Float[Array, " n"],
) -> Float[Array, " n"]:  # fmt: skip
    """Return `bad` where `on`, else `good`, differentiable by onset and end of the fault.

    Shifting the onset between two samples changes no value. The derivative is therefore taken from
    the line between the values at both samples: each further period of the fault adds one
    difference `bad - good` to the sum over the samples.

    **Arguments:**
    - `on`: whether the fault acts; `live`: whether the instant lies between onset and end, where a
      slightly severer fault would act; `possible`: whether the fault happens at all.
    - `lead`, `trail`: periods since the onset, and since the end.
    """
    return jnp.where(on, bad, good)


@_blend.defjvp
def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    _, live, possible, lead, trail, bad, good = primals
    *_, dlead, dtrail, dbad, dgood = tangents
    gap = jnp.where(possible, bad - good, 0.0)
    begins = jnp.where(jnp.abs(lead) < 1, gap * (1 - jnp.abs(lead)), 0.0)
    ends = jnp.where(jnp.abs(trail) < 1, gap * (1 - jnp.abs(trail)), 0.0)
    edges = begins * dlead - ends * dtrail
    return _blend(*primals), jnp.where(live, dbad, dgood) + edges


def _uniform(seed: Any, step: Any, count: int, xp: Any) -> Float[Any, " count"]:
    """Return random numbers between 0 and 1, determined by the seed (two words) and the step.

    JAX's generator would cost more than a step of a small plant, even for a fault that is off. Two
    rounds of a hash over 32 bits suffice for noise, and NumPy gives the same numbers.
    """
    entry = xp.arange(count, dtype=np.uint32) * xp.uint32(0x9E3779B9)
    word = mixed_bits(entry + xp.asarray(step).astype(np.uint32) ^ seed[0])
    word = mixed_bits(word + seed[1])
    # Of 24 bits, which float32 holds; never 0 nor 1.
    return ((word >> 8).astype(np.float32) + xp.float32(0.5)) * xp.float32(2**-24)


def inject(fault: Fault, passing: Passing, choice: tuple[str, int] | None = None) -> Injected:
    """Return a link that applies a fault in the loop of a system.

    **Raises:** `UnknownNameError` for a channel that the system does not have; `ValueError` for one
    that cannot have this fault.
    """
    kind, entries = type(fault).__name__, passing.entries(fault.channel)
    if entries.whole and not fault.choices:
        raise ValueError(
            f"channel {fault.channel!r} has whole numbers, such as choices, which {kind} cannot "
            "change; Dropout, Stuck, Freeze, Delay, HeldAction and PacketLoss can"
        )
    other = None
    if isinstance(fault, WrongChannel):
        other = passing.entries(fault.source)
        if other.side != entries.side or other.count not in (1, entries.count):
            raise ValueError(
                f"source of WrongChannel must be part of the same {entries.side} as "
                f"{fault.channel!r}, with 1 or {entries.count} entries; got {fault.source!r}"
            )
    return Injected(fault, entries, other, choice)


def with_faults(problem: Problem, faults: Sequence[object], by_simulator: bool = False) -> Problem:
    """Return a problem with faults; see `Problem.with_faults`."""
    chosen, features = _each(faults), {}
    if not chosen:
        raise ValueError("with_faults needs at least one fault; got none")
    names, space = [*problem.space.domains], problem.space
    for each in (*(e for e in faults if isinstance(e, AtMost)), *(fault for fault, _ in chosen)):
        if each.name in names:
            raise ValueError(
                f"there is a feature or a fault {each.name!r} already: give the fault another "
                "name=..."
            )
        names.append(each.name)
        if each.domains:
            features[each.name] = FaultFeatures(each)
    system, nominal = problem.system, problem.nominal
    if not by_simulator:
        passing = system.passing(space.feature_form)
        system = system.with_links(tuple(inject(f, passing, choice) for f, choice in chosen))
    if nominal is not None:
        nominal = {**nominal, **{name: domain.nominal for name, domain in features.items()}}
    space = FeatureSpace({**space.domains, **features}, space.where)
    return replace(problem, space=space, system=system, nominal=nominal)


def _each(faults: Sequence[object]) -> list[tuple[Fault, tuple[str, int] | None]]:
    """Return each fault with the feature that chooses it, if any, and its number there."""
    found = []
    for each in faults:
        if isinstance(each, AtMost):
            found += [(fault, (each.name, i)) for i, fault in enumerate(each.faults, 1)]
        elif isinstance(each, Fault):
            found.append((each, None))
        else:
            raise ValueError(f"with_faults takes faults, such as vj.faults.Bias; got {each!r}")
    return found


class OnHost:
    """Faults in the loop of your own simulator; made by `on_host`."""

    def __init__(
        self, faults: Sequence[object], features: PyTree, seed: int, period: float
    ) -> None:
        self._faults, self._given = _each(faults), (features, seed, period)
        self._loops: dict[Side, tuple[Channels, Any]] = {}

    def observation(self, time: float, value: PyTree) -> PyTree:
        """Return the faulty observation at `time` seconds; call it once at each instant."""
        return self._through("observation", time, value)

    def action(self, time: float, value: PyTree) -> PyTree:
        """Return the faulty action at `time` seconds; call it once at each instant."""
        return self._through("action", time, value)

    def _through(self, side: Side, time: float, value: PyTree) -> PyTree:
        if side not in self._loops:
            features, seed, period = self._given
            forms = {"observation": (), "action": (), side: jax.tree.map(np.asarray, value)}
            passing = Passing(**forms, period=period, duration=np.inf)
            own = [each for each in self._faults if each[0].channel.startswith(side)]
            links = tuple(inject(fault, passing, choice) for fault, choice in own)
            channels = Channels(links, period, features, np)
            self._loops[side] = channels, channels.begin(None, None, seed)
        channels, states = self._loops[side]
        value, states = getattr(channels, side)(states, value, time)
        self._loops[side] = channels, states
        return value


def on_host(
    faults: Sequence[Fault | AtMost], features: PyTree, seed: int = 0, *, period: float
) -> OnHost:
    """Apply faults in your own simulator, such as a client of `remote`.

    **Arguments:**
    - `faults`: the faults given to `problem.with_faults(..., by_simulator=True)`; each channel
      begins with `observation` or `action`.
    - `features`: the features of the simulation, as the simulator receives them.
    - `seed`: the seed of the simulation, used by random faults.
    - `period`: seconds between two observations.
    """
    return OnHost(faults, features, seed, period)
