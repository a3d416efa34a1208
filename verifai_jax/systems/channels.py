"""The way of observations and actions between a system and its policy, and its links.

    channels = Channels(links, period, features)
    states = channels.begin(observation, action, key)
    observed, states = channels.observation(states, observation, time)
    action, states = channels.action(states, decided, time)

This is the one seam in the loop of every system that has one. Delays and faults are links.
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
    """The instant at which something passes.

    - `time`: in seconds; `period`: between two of them.
    - `features`: the features of the simulation.
    - `xp`: `jax.numpy`, or `numpy` on the host.
    - `ended`: whether the simulation has ended, so that nothing new is remembered.
    """

    time: Any
    period: float
    features: PyTree
    xp: Any = jnp
    ended: Bool[Array, ""] | bool = False

    @property
    def step(self) -> Any:
        """The number of instants before this one."""
        return self.xp.round(self.xp.asarray(self.time) / self.period).astype(np.int32)

    def kept(self, before: PyTree, after: PyTree) -> Any:
        """Return what is remembered from here on: `after`, or `before` if it has ended."""
        if self.ended is False:
            return after
        return jax.tree.map(lambda old, new: self.xp.where(self.ended, old, new), before, after)


class Link:
    """Something that observations, or actions, pass through.

    - `side`: which of the two.
    - `features`: names of the features that it reads.
    - `draws`: whether it draws random numbers.
    - `arrays`: names of the parts of an observation that it reads for others, see `Entries`.
    """

    side: Side = "observation"
    draws: bool = False

    @property
    def features(self) -> tuple[str, ...]:
        return ()

    @property
    def arrays(self) -> tuple[str, ...]:
        return ()

    def begin(self, value: PyTree, now: Instant, key: Key[Array, ""] | int | None) -> PyTree:
        """Return what it remembers at first, of values of this form."""
        return ()

    def through(self, state: PyTree, value: PyTree, now: Instant) -> tuple[PyTree, PyTree]:
        """Return what comes out at this instant, and what it remembers then, as `now.kept`."""
        raise NotImplementedError

    def valid(self, features: PyTree) -> Any:
        """Return whether its numbers are what they may be."""
        return True

    def refusal(self, features: PyTree, owner: str) -> str | None:
        """Return what is wrong with its numbers; None if nothing is."""
        return None

    def check(self, features: PyTree) -> None:
        """Refuse features (`jax.ShapeDtypeStruct`s) that it cannot read.

        **Raises:** `ValueError`.
        """


class Channels(NamedTuple):
    """The links of one simulation, in their order."""

    links: tuple[Link, ...]
    period: float
    features: PyTree
    xp: Any = jnp

    def begin(
        self, observation: PyTree, action: PyTree, key: Key[Array, ""] | int | None
    ) -> States:
        """Return what the links remember at first, given values of the right forms.

        An action is the one that stands for none.
        """
        first = {"observation": observation, "action": action}
        now = Instant(0.0, self.period, self.features, self.xp)
        return tuple(link.begin(first[link.side], now, key) for link in self.links)

    def observation(
        self, states: States, value: PyTree, time: Any, ended: Bool[Array, ""] | bool = False
    ) -> tuple[Any, States]:
        """Return what the policy sees at `time` seconds, and what the links remember then.

        Where the simulation has ended, they remember what they did before.
        """
        return self._through("observation", states, value, time, ended)

    def action(
        self, states: States, value: PyTree, time: Any, ended: Bool[Array, ""] | bool = False
    ) -> tuple[Any, States]:
        """Return the action that takes effect at `time`, and what the links remember then."""
        return self._through("action", states, value, time, ended)

    def valid(self) -> Any:
        """Return whether all numbers of the links are what they may be."""
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
    """Return what is wrong with the numbers of the first link that `owner` cannot have; or None.

    **Arguments:**
    - `features`: numbers by name.
    """
    return next(filter(None, (link.refusal(features, owner) for link in links)), None)


class NamedNumbers(NamedTuple):
    """Numbers that have a name of their own: those at `index` of a part of one side; all if None.

    `part` is the name of a leaf, as in `sensordata`; empty where the whole is one array.
    """

    side: Side
    part: str
    index: tuple[int, ...] | None = None


class Passing(NamedTuple):
    """The things that pass between a system and its policy, for a fault to be put in.

    - `observation`, `action`: forms, as `jax.ShapeDtypeStruct`s.
    - `period`: seconds between two decisions; `duration`: of a simulation.
    - `names`: the names of single numbers, in addition to the names of the parts.
    - `hidden`: parts of an observation that the whole of it does not include, such as the time.
    """

    observation: PyTree
    action: PyTree
    period: float
    duration: float
    names: Mapping[str, NamedNumbers] = {}
    hidden: tuple[str, ...] = ()

    def entries(self, channel: str) -> "Entries":
        """Return the numbers that a channel names.

        **Arguments:**
        - `channel`: `"observation"`, `"action"`, a name, or either with an index: `"action[0]"`.
        **Raises:** `UnknownNameError` with the nearest channel; `ValueError` for an index that does
        not exist, and a channel without numbers.
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
    """Numbers within an observation or an action: of some leaves, the entries at flat indices.

    - `whole`: whether they are whole numbers, such as choices.
    - `names`: the names of the leaves, where single ones were named.
    """

    side: Side
    parts: tuple[tuple[int, tuple[int, ...]], ...]
    whole: bool
    names: tuple[str, ...] = ()

    @property
    def count(self) -> int:
        """The number of them."""
        return sum(len(index) for _, index in self.parts)

    def take(self, value: PyTree, xp: Any) -> Float[Any, " count"]:
        """Return the numbers as a vector."""
        leaves = jax.tree.leaves(value)
        taken = [xp.ravel(xp.asarray(leaves[i])) for i, _ in self.parts]
        for at, (_, index) in enumerate(self.parts):
            if index != tuple(range(taken[at].size)):
                taken[at] = taken[at][np.asarray(index)]
        return taken[0] if len(taken) == 1 else xp.concatenate(taken)

    def put(self, value: PyTree, numbers: Float[Any, " count"], xp: Any) -> Any:
        """Return the value with these numbers in it."""
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
