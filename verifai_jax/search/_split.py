"""Composition of searches: one for each part of the space.

    Split({"wind": CrossEntropy(), "cars": "halton"}, rest="uniform")
    Split({"x0": Grid(5), "alg": Grid()}, rest=Uniform())

Every part receives its own coordinates and the robustness of the whole simulation. For a part that
learns, the other coordinates are noise, so put interacting features into one part.
"""

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

from verifai_jax.core.messages.errors import unknown_name
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Asked, Observations, Plan, Search, Wants


@dataclass(frozen=True, init=False)
class Split(Search[tuple[PyTree, ...]]):
    """A separate search for each part of the space, and one for the rest.

    **Arguments:**
    - `parts`: feature name -> search; `"cars"` means all of `cars[0].x`, `cars[0].v`, ...; several
      names for one search are written `"x0, v0"`.
    - `rest`: the search of all other features.

    The composition ends when its first finite part (a grid) ends, and samples the prior if all
    parts do. The first part that wants gradients sets the temperature, the first one that plans its
    rounds sets the plan.

    **Raises:** `ValueError` for no parts; `TypeError` for a part that is not a search. `check`
    raises `ValueError` for a name that is not a feature, a feature in two parts, or a part that
    cannot work on its features.
    """

    parts: tuple[tuple[str, Search], ...]
    rest: Search

    def __init__(self, parts: Mapping[str, Search], rest: Search) -> None:
        pairs = tuple(parts.items() if isinstance(parts, Mapping) else parts)
        if not pairs:
            raise ValueError("a Split needs at least one part; got none")
        for name, search in (*pairs, ("the rest", rest)):
            if not isinstance(search, Search):
                raise TypeError(f"the part {name!r} of a Split must be a search; got {search!r}")
        object.__setattr__(self, "parts", pairs)
        object.__setattr__(self, "rest", rest)

    @property
    def searches(self) -> tuple[Search, ...]:
        """The searches of the parts, with that of the rest last."""
        return (*(search for _, search in self.parts), self.rest)

    @property
    def wants(self) -> Wants:
        wants = reduce(operator.or_, (search.wants for search in self.searches))
        # A model of the traces knows no parts.
        return replace(wants, traces=None)

    @property
    def fallback(self) -> "Split | None":
        """The same composition with the fallback of each part that follows derivatives."""
        parts = [each.fallback if each.wants.derivatives else each for each in self.searches]
        known = [each for each in parts if each is not None]
        if not self.wants.derivatives or len(known) < len(parts):
            return None
        return self._of(known)

    def staying(self) -> "Split":
        return self._of([each.staying() for each in self.searches])

    def _of(self, searches: Sequence[Search]) -> "Split":
        """Return the same composition of other searches, in the order of the parts."""
        names = (name for name, _ in self.parts)
        return Split(dict(zip(names, searches, strict=False)), searches[-1])

    @property
    def samples_prior(self) -> bool:
        return all(search.samples_prior for search in self.searches)

    @property
    def learns(self) -> bool:
        return any(search.learns for search in self.searches)

    def check(self, cube: Cube) -> None:
        for search, _, part in self._shares(cube):
            search.check(part)

    def total(self, cube: Cube) -> int | None:
        totals = [search.total(part) for search, _, part in self._shares(cube)]
        return min((total for total in totals if total is not None), default=None)

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> tuple[PyTree, ...]:
        shares = self._shares(cube)
        keys = jax.random.split(key, len(shares))
        return tuple(
            search.init(key, part, batch)
            for key, (search, _, part) in zip(keys, shares, strict=True)
        )

    def ask(self, state: tuple[PyTree, ...], cube: Cube, batch: int) -> Asked[tuple[PyTree, ...]]:
        u = jnp.zeros((batch, cube.dim), jnp.float32)
        states = []
        for its, (search, indices, part) in zip(state, self._shares(cube), strict=True):
            points, its = search.ask(its, part, batch)
            u = u.at[:, indices].set(points)
            states.append(its)
        return u, tuple(states)

    def tell(
        self, state: tuple[PyTree, ...], cube: Cube, observations: Observations
    ) -> tuple[PyTree, ...]:
        return self._learn("tell", state, cube, observations)

    def warm_start(
        self, state: tuple[PyTree, ...], cube: Cube, observations: Observations
    ) -> tuple[PyTree, ...]:
        return self._learn("warm_start", state, cube, observations)

    def temperature(self, state: tuple[PyTree, ...]) -> Float[Array, ""]:
        """Return the temperature of the first part that wants gradients."""
        for search, its in zip(self.searches, state, strict=True):
            if search.wants.gradient:
                return search.temperature(its)
        return super().temperature(state)

    def plan(self, state: tuple[PyTree, ...], cube: Cube, batch: int) -> Plan:
        """Return the plan of the first part that has plans."""
        for its, (search, _, part) in zip(state, self._shares(cube), strict=True):
            if search.wants.clauses:
                return search.plan(its, part, batch)
        return super().plan(state, cube, batch)

    def _learn(
        self, verb: str, state: tuple[PyTree, ...], cube: Cube, observations: Observations
    ) -> tuple[PyTree, ...]:
        states = []
        for its, (search, indices, part) in zip(state, self._shares(cube), strict=True):
            seen = search.wants.only(observations)
            gradient, clause_gradients = seen.gradient, seen.clause_gradients
            seen = seen._replace(
                u=seen.u[:, indices],
                gradient=None if gradient is None else gradient[:, indices],
                clause_gradients=(
                    None if clause_gradients is None else clause_gradients[:, :, indices]
                ),
            )
            states.append(getattr(search, verb)(its, part, seen))
        return tuple(states)

    def _shares(self, cube: Cube) -> list[tuple[Search, np.ndarray, Cube]]:
        """Return each search with its coordinates, as indices and as a cube of their own."""
        owner = np.full(cube.dim, len(self.parts))
        for number, (names, _) in enumerate(self.parts):
            for name in map(str.strip, names.split(",")):
                indices = [i for i, label in enumerate(cube.names) if _covers(name, label)]
                if not indices:
                    raise unknown_name("feature", name, dict.fromkeys(map(_top, cube.names)))
                for i in indices:
                    if owner[i] != len(self.parts):
                        raise ValueError(f"feature {cube.names[i]!r} is in two parts of the Split")
                    owner[i] = number
        shares = []
        for number, search in enumerate(self.searches):
            indices = np.flatnonzero(owner == number)
            shares.append((search, indices, cube.take(tuple(indices.tolist()))))
        return shares


def _covers(name: str, label: str) -> bool:
    """Return whether a coordinate called `label` belongs to the feature `name`."""
    return label == name or label.startswith((f"{name}.", f"{name}["))


def _top(label: str) -> str:
    return label.split(".")[0].split("[")[0]
