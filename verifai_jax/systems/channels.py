"""The path of observations and actions between a system and its policy, and its links.

    channels = Channels(links, period, features)
    states = channels.begin(observation, action, key)
    observed, states = channels.observation(states, observation, time)
    action, states = channels.action(states, decided, time)

Every system with a policy in its loop uses this path. Delays and faults are links.
"""

import re
from collections.abc import Iterable, Mapping
from typing import Any, Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PyTree

from verifai_jax.core.messages.errors import unknown_name

Side: TypeAlias = Literal["observation", "action"]
SIDES: tuple[Side, Side] = ("observation", "action")
States: TypeAlias = tuple[PyTree, ...]


class Instant(NamedTuple):
    """The instant at which a value passes through a link.

    - `time`: time in seconds; `period`: seconds between two instants.
    - `features`: the features of the simulation.
    - `xp`: `jax.numpy`, or `numpy` on the host.
    - `ended`: whether the simulation has ended, so that memory no longer changes.
    """

    time: Any
    period: float
    features: PyTree
    xp: Any = jnp
    ended: Bool[Array, ""] | bool = False

    @property
    def step(self) -> Any:
        """Number of earlier instants."""
        return self.xp.round(self.xp.asarray(self.time) / self.period).astype(np.int32)

    def kept(self, before: PyTree, after: PyTree) -> Any:
        """Return the new memory: `after`, or `before` if the simulation has ended."""
        if self.ended is False:
            return after
        return jax.tree.map(lambda old, new: self.xp.where(self.ended, old, new), before, after)


class Link:
    """A link in the path of observations or actions, such as a delay or a fault.

    - `side`: whether it is in the path of observations or of actions.
    - `features`: names of the features that it reads.
    - `draws`: whether it uses random numbers.
    - `arrays`: names of the parts of an observation that it reads in addition; see `Entries`.
    - `decides`: whether it stands in for the policy, ahead of all delays and faults of actions.
    """

    side: Side = "observation"
    draws: bool = False
    decides: bool = False

    @property
    def features(self) -> tuple[str, ...]:
        return ()

    @property
    def arrays(self) -> tuple[str, ...]:
        return ()

    def begin(self, value: PyTree, now: Instant, key: Key[Array, ""] | int | None) -> PyTree:
        """Return its initial memory, for values of this form."""
        return ()

    def through(self, state: PyTree, value: PyTree, now: Instant) -> tuple[PyTree, PyTree]:
        """Return the output at this instant, and the new memory, from `now.kept`."""
        raise NotImplementedError

    def valid(self, features: PyTree) -> Any:
        """Return whether its numbers are valid."""
        return True

    def refusal(self, features: PyTree, owner: str) -> str | None:
        """Return the problem with its numbers; None if they are valid."""
        return None

    def check(self, features: PyTree) -> None:
        """Refuse features (`jax.ShapeDtypeStruct`s) that it cannot read.

        **Raises:** `ValueError`.
        """


class Channels(NamedTuple):
    """The links of one simulation, in order."""

    links: tuple[Link, ...]
    period: float
    features: PyTree
    xp: Any = jnp

    def begin(
        self, observation: PyTree, action: PyTree, key: Key[Array, ""] | int | None
    ) -> States:
        """Return the initial memory of the links, for values of these forms.

        The given action is the default before any decision.
        """
        first = {"observation": observation, "action": action}
        now = Instant(0.0, self.period, self.features, self.xp)
        return tuple(link.begin(first[link.side], now, key) for link in self.links)

    def observation(
        self, states: States, value: PyTree, time: Any, ended: Bool[Array, ""] | bool = False
    ) -> tuple[Any, States]:
        """Return the observation that the policy receives at `time` s, and the links' new memory.

        If the simulation has ended, their memory stays unchanged.
        """
        return self._through("observation", states, value, time, ended)

    def action(
        self, states: States, value: PyTree, time: Any, ended: Bool[Array, ""] | bool = False
    ) -> tuple[Any, States]:
        """Return the action that takes effect at `time`, and the links' new memory."""
        return self._through("action", states, value, time, ended)

    def valid(self) -> Any:
        """Return whether all numbers of the links are valid."""
        valid: Any = True
        for link in self.links:
            valid = valid & link.valid(self.features)
        return valid

    def _through(
        self, side: Side, states: States, value: PyTree, time: Any, ended: Any
    ) -> tuple[Any, States]:
        now, after = Instant(time, self.period, self.features, self.xp, ended), list(states)
        for i, link in enumerate(self.links):
            if link.side == side:
                value, after[i] = link.through(states[i], value, now)
        return value, tuple(after)


NOTHING_PASSED = Channels((), 1.0, {})
"""Observations and actions as they are."""


def first_refusal(links: Iterable[Link], features: PyTree, owner: str) -> str | None:
    """Return the problem with the first link's invalid numbers, for `owner`; None if all are valid.

    **Arguments:**
    - `features`: numbers by name.
    """
    return next(filter(None, (link.refusal(features, owner) for link in links)), None)


class NamedNumbers(NamedTuple):
    """Named numbers: those at `index` of a part of observation or action; all if None.

    `part` is the name of a leaf, such as `sensordata`; empty if there is a single array.
    """

    side: Side
    part: str
    index: tuple[int, ...] | None = None


class Passing(NamedTuple):
    """The values that pass between a system and its policy, on which faults can act.

    - `observation`, `action`: their forms, as `jax.ShapeDtypeStruct`s.
    - `period`: seconds between two decisions; `duration`: that of a simulation.
    - `names`: names of single numbers, in addition to the names of the parts.
    - `hidden`: parts of an observation that do not belong to the whole, such as the time.
    - `bounds`: the lowest and the highest action, numbers or arrays in its form; None if unknown.
    """

    observation: PyTree
    action: PyTree
    period: float
    duration: float
    names: Mapping[str, NamedNumbers] = {}
    hidden: tuple[str, ...] = ()
    bounds: tuple[PyTree, PyTree] | None = None

    def entries(self, channel: str) -> "Entries":
        """Return the numbers selected by a channel.

        **Arguments:**
        - `channel`: `"observation"`, `"action"`, a name, or either with an index: `"action[0]"`.
        **Raises:** `UnknownNameError` with the nearest channel; `ValueError` for an index that does
        not exist, and for a channel without numbers.
        """
        matched = re.fullmatch(r"(.+?)(?:\[(-?\d+)\])?", channel.strip())
        name, number = (channel, None) if matched is None else matched.groups()
        parts = {side: _named_parts(getattr(self, side)) for side in SIDES}
        named = {
            f"{side}.{part}": NamedNumbers(side, part) for side in SIDES for part in parts[side]
        }
        plain = {part: NamedNumbers(side, part) for side in reversed(SIDES) for part in parts[side]}
        named = {**named, **plain, **self.names}
        if name in SIDES:
            side: Side = name  # pyright: ignore[reportAssignmentType]
            shown = [part for part in parts[side] if part not in self.hidden]
            found = [(part, None) for part in _of_one_kind(parts[side], shown)]
        elif name in named:
            side = named[name].side
            found = [(named[name].part, named[name].index)]
        else:
            known = [known for known in named if known and not known.endswith(".")]
            raise unknown_name("channel", channel, [*SIDES, *known])
        order = list(parts[side])
        chosen, kinds, size = [], [], 0
        for part, index in found:
            form = parts[side][part]
            index = index if index is not None else tuple(range(int(np.prod(form.shape))))
            if not index:
                continue
            chosen.append((order.index(part), index))
            kinds.append(form.dtype)
            size += len(index)
        if not size:
            raise ValueError(f"channel {channel!r} has no numbers that a fault could change")
        if number is not None:
            if not -size <= int(number) < size:
                raise ValueError(f"channel {name!r} has {size} entries; got {channel!r}")
            wanted = int(number) % size
            for leaf, index in chosen:
                if wanted < len(index):
                    chosen = [(leaf, (index[wanted],))]
                    break
                wanted -= len(index)
        whole = all(
            jnp.issubdtype(kind, jnp.integer) or jnp.issubdtype(kind, jnp.bool_) for kind in kinds
        )
        names = tuple(part for part, _ in found) if name not in SIDES else ()
        return Entries(side, tuple(chosen), whole, names)


class Entries(NamedTuple):
    """Selected numbers of an observation or an action: leaves, with flat indices into them.

    - `whole`: whether they are integers, such as choices.
    - `names`: the names of the leaves, if single leaves were selected.
    """

    side: Side
    parts: tuple[tuple[int, tuple[int, ...]], ...]
    whole: bool
    names: tuple[str, ...] = ()

    @property
    def count(self) -> int:
        """Number of selected entries."""
        return sum(len(index) for _, index in self.parts)

    def take(self, value: PyTree, xp: Any) -> Float[Any, " count"]:
        """Return the selected numbers as a vector."""
        leaves = jax.tree.leaves(value)
        taken = [xp.ravel(xp.asarray(leaves[i])) for i, _ in self.parts]
        for at, (_, index) in enumerate(self.parts):
            if index != tuple(range(taken[at].size)):
                taken[at] = taken[at][np.asarray(index)]
        return taken[0] if len(taken) == 1 else xp.concatenate(taken)

    def put(self, value: PyTree, numbers: Float[Any, " count"], xp: Any) -> Any:
        """Return a copy of the value in which the selected numbers are replaced by these."""
        leaves, form = jax.tree.flatten(value)
        start = 0
        for i, index in self.parts:
            leaf, part = xp.asarray(leaves[i]), numbers[start : start + len(index)]
            start += len(index)
            part = part.astype(leaf.dtype)
            if index == tuple(range(leaf.size)):
                flat = part
            elif xp is np:
                flat = np.array(leaf).ravel()
                flat[list(index)] = part
            else:
                flat = leaf.ravel().at[np.asarray(index)].set(part)
            leaves[i] = flat.reshape(leaf.shape)[()] if xp is np else flat.reshape(leaf.shape)
        return jax.tree.unflatten(form, leaves)


def _named_parts(form: PyTree) -> dict[str, Any]:
    """Return the leaves that have numbers or other content, by name."""
    leaves = jax.tree_util.tree_flatten_with_path(form)[0]
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def _of_one_kind(forms: Mapping[str, Any], names: Iterable[str]) -> list[str]:
    """Return the parts of real numbers; without any, those of whole numbers."""
    names = [name for name in names if hasattr(forms[name], "dtype")]
    real = [name for name in names if jnp.issubdtype(forms[name].dtype, jnp.floating)]
    return real or [n for n in names if jnp.issubdtype(forms[n].dtype, jnp.integer)]
