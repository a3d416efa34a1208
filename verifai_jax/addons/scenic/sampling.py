"""Scenes of a program at given features, computed by Scenic itself.

    sampling = Sampling(compiled)
    sampling.domains                                    # features by name
    values = sampling.values({"ego.position.x": 1.0, ...})
    sampling.refusal(values, features)                  # None, or why Scenic refuses it
    sampling.scene(values)                              # Scenic's Scene

The same features give the same scene, bit for bit. Scenic has global state, so only one thread
computes at a time.
"""

import hashlib
import random
import sys
import threading
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp
import numpy as np

from verifai_jax.addons.scenic import leaves
from verifai_jax.addons.scenic.compilation import Compiled, ProgramError
from verifai_jax.addons.scenic.graph import field, is_constructed, is_random, kind_of, law, nodes
from verifai_jax.addons.scenic.leaf_reading import leaf_of
from verifai_jax.addons.scenic.naming import leaf_names, owner_names, unique
from verifai_jax.features import Array, Box, Categorical
from verifai_jax.features.domain import Domain

SEED = "seed"
"""Name of the feature that seeds what has no inverse."""
COMPUTED = {
    *("OperatorDistribution", "AttributeDistribution", "FunctionDistribution"),
    *("MethodDistribution", "VectorOperatorDistribution", "VectorMethodDistribution"),
    *("TupleDistribution", "SliceDistribution", "StarredDistribution", "TypecheckedDistribution"),
    *("MultiplexerDistribution", "Options", "VerifaiOptions", "UniformDistribution"),
}
"""Distributions of Scenic that draw nothing themselves."""
GUESSES = 64
"""Random positions that are tried for what a scene does not tell."""
LOCK = threading.RLock()
"""Held while Scenic computes."""


class Refused(Exception):
    """An error for a scene that Scenic refuses while drawing it."""


class Sampling:
    """Scenes of one program as a function of features.

    - `scenario`: Scenic's `Scenario`.
    - `order`: its random nodes, each after its dependencies.
    - `leaves`: the nodes with an inverse, by identity.
    - `seeded`: names of the nodes without an inverse, by identity.
    - `owners`: names of the objects, by identity.
    - `soft`: soft requirements by the name of their feature.
    - `domains`: all features by name.
    """

    def __init__(self, compiled: Compiled) -> None:
        self.scenario = compiled.scenario
        self.order = nodes(self.scenario.dependencies)
        variables = compiled.names
        self.owners = owner_names(self.scenario, variables, self.order)
        names = leaf_names(self.scenario, self.owners, variables, self.order)
        self.leaves: dict[int, leaves.Leaf] = {}
        self.seeded: dict[int, str] = {}
        self.domains: dict[str, Domain] = {}
        self._external = False
        self._assign(names)
        self.soft = self._soft()
        for name in self.soft:
            probability = float(self.soft[name].prob)
            weights = [1 - probability, probability]
            self.domains[name] = Categorical(False, True, weights=weights)
        if self.seeded or (not self.domains and self.is_dynamic):
            self.domains[SEED] = Box(0, 1)

    @property
    def is_dynamic(self) -> bool:
        """True if the program is dynamic: it or the simulator may draw random numbers later."""
        parts = self.scenario.dynamicScenario
        behaves = any(field(body, "behavior") is not None for body in self.scenario.objects)
        composed = getattr(parts, "_compose", None) is not None
        over_time = (
            *self.scenario.monitors,
            *self.scenario.recordedExprs,
            *self.scenario.terminationConditions,
            *self.scenario.terminateSimulationConditions,
        )
        return behaves or composed or bool(over_time) or self.scenario.simulator is not None

    def _assign(self, names: Mapping[int, str]) -> None:
        """Give each random leaf its features, or a part in the seed."""
        options = {
            id(field(law(node), "index")): field(law(node), "options")
            for node in self.order
            if kind_of(law(node)) in ("Options", "VerifaiOptions")
        }
        for node in self.order:
            drawn = law(node)
            name = names.get(id(node)) or kind_of(drawn).lower()
            if is_constructed(node):
                if _mutates(node):
                    self.seeded[id(node)] = f"mutation of {self.owners[id(node)]}"
                continue
            leaf = leaf_of(node, "", options.get(id(node)))
            if leaf is not None:
                taken = {known.name for known in self.leaves.values()}
                leaf = leaf_of(node, unique(name, taken | {SEED}), options.get(id(node)))
                assert leaf is not None
                if field(drawn, "isTimeSeries"):
                    leaf = self._series(leaf)
                self.leaves[id(node)] = leaf
                self.domains.update(leaf.domains)
            elif _draws(drawn):
                self.seeded[id(node)] = f"{name} ({kind_of(drawn)})"
                self._external |= kind_of(drawn) not in COMPUTED and hasattr(type(drawn), "sampler")

    def _series(self, leaf: leaves.Leaf) -> leaves.Leaf:
        """Return the leaf of a value at each step."""
        bound = self.scenario.params.get("timeBound")
        if isinstance(bound, bool) or not isinstance(bound, int) or bound < 1:
            raise ProgramError(
                f"the TimeSeries {leaf.name} needs a number of steps: write `param timeBound = 50`"
            )
        domains = {name: Array(domain, bound) for name, domain in leaf.domains.items()}
        return leaves.Series(leaf.node, leaf.name, domains, leaf)

    def _soft(self) -> dict[str, Any]:
        soft: dict[str, Any] = {}
        for requirement in self.scenario.userRequirements:
            if requirement.prob < 1:
                name = f"line{requirement.line}"
                soft[unique(f"require.{name}", {*soft, *self.domains})] = requirement
        return soft

    def values(self, features: Mapping[str, Any]) -> Any:
        """Return the value of each node at these features, in Scenic's form.

        **Arguments:**
        - `features`: numbers and choices by name, as returned by `FeatureSpace.unflatten`.
        **Raises:** `Refused` if Scenic refuses the scene while drawing it.
        """
        distributions = sys.modules["scenic.core.distributions"]
        utils = sys.modules["scenic.core.utils"]
        values = utils.DefaultIdentityDict()
        seed = f"{float(features.get(SEED, 0.0)):z.9g}"
        with LOCK, _seeded_generators(0):
            if self.scenario.externalSampler is not None:
                _seed_generators(digest(seed, "external"))
                self.scenario.externalSampler.sample(None)
            try:
                for i, node in enumerate(self.order):
                    leaf = self.leaves.get(id(node))
                    if leaf is not None:
                        values[node] = self._drawn(leaf, features, values.__getitem__)
                        continue
                    if id(node) in self.seeded:
                        _seed_generators(digest(seed, str(i)))
                    values[node] = law(node).sampleGiven(values)
            except (distributions.RejectionException, leaves.NothingToDrawError) as error:
                raise Refused(str(error)) from error
        return values

    def _drawn(
        self, leaf: leaves.Leaf, features: Mapping[str, Any], given: Callable[[Any], Any]
    ) -> Any:
        parts = {name: _plain(features[name]) for name in leaf.domains}
        value = leaf.draw(parts, given, np)
        if not leaf.is_point:
            return value if isinstance(value, int | leaves.SeriesValue) else float(value)
        vectors = sys.modules["scenic.core.vectors"]
        region = given(field(law(leaf.node), "region"))
        x, y = float(value[0]), float(value[1])
        if isinstance(leaf, leaves.OnPolyline):
            if region._usingDefaultOrientation:
                return vectors.OrientedVector(x, y, 0, float(leaf.heading(parts, np)))
            return region.orient(vectors.Vector(x, y, 0))
        return region.orient(vectors.Vector(x, y, region.z))

    def refusal(self, values: Any, features: Mapping[str, Any]) -> str | None:
        """Return the reason why Scenic's own checker refuses a scene; None if it accepts it."""
        with LOCK, _seeded_generators(0):
            self.activate(features)
            return self.scenario.checker.checkRequirements(values)

    def activate(self, features: Mapping[str, Any]) -> None:
        """Switch the soft requirements on or off according to the features."""
        for requirement in self.scenario.userRequirements:
            requirement.active = True
        for name, requirement in self.soft.items():
            requirement.active = bool(_plain(features[name]))

    def scene(self, values: Any, features: Mapping[str, Any] = MappingProxyType({})) -> Any:
        """Return Scenic's `Scene` of these values, with the features that the program only reads.

        Those become global parameters.
        """
        with LOCK:
            scene = self.scenario._makeSceneFromSample(values)
        given = {name: _plain(v) for name, v in features.items() if name not in self.domains}
        scene.params = {**scene.params, **given}
        return scene

    def check_own(self, scene: Any) -> None:
        """Refuse a scene that does not come from this compilation of the program."""
        if not hasattr(scene, "sample") or not hasattr(scene, "dynamicScenario"):
            raise ValueError(f"a scene is one that Scenic draws; got {type(scene).__name__}")
        if scene.dynamicScenario is not self.scenario.dynamicScenario:
            raise ValueError(
                "this scene comes from another program, or from another compilation of this one, "
                "whose random values are other objects: carry it over as bytes, by "
                "program.from_bytes(other.to_bytes(scene)), where `other` made it"
            )

    def features_of(self, scene: Any) -> dict[str, Any]:
        """Return the features that give a scene of Scenic's own sampler.

        A feature that the scene does not determine gets the middle of its domain, like the seed, or
        another value if the scene is impossible there.

        **Raises:** `ValueError` for a scene of another compilation.
        """
        self.check_own(scene)
        random = np.random.default_rng(0)
        refusals = sys.modules["scenic.core.distributions"].RejectionException
        why = ""
        with LOCK, _seeded_generators(0):
            for unit_value in (0.5, 0.0, 1.0, *([None] * GUESSES)):
                try:
                    features, complete = self._inverted(scene.sample, unit_value, random)
                    if not complete:
                        for name, value in features.items():
                            self.domains[name].check(value, name)
                    break
                except (ValueError, refusals) as error:
                    why = f": {error}"
            else:
                raise ValueError(
                    f"this scene does not tell the features at which it would come{why}"
                )
        features.update({name: bool(r.active) for name, r in self.soft.items()})
        if SEED in self.domains:
            features[SEED] = 0.5
        return {name: features[name] for name in self.domains}

    def _inverted(
        self, sample: Any, unit_value: float | None, random: np.random.Generator
    ) -> tuple[dict[str, Any], bool]:
        """Return the features of what Scenic drew, and whether it tells all of them.

        Scenic keeps no value of an option that was not chosen, and its bytes none of the ends of an
        interval: their features are at this position of the unit interval, or at random ones.
        """
        values = sys.modules["scenic.core.utils"].DefaultIdentityDict()
        features: dict[str, Any] = {}
        complete = True
        for node in self.order:
            leaf, given = self.leaves.get(id(node)), node in sample
            if given:
                values[node] = sample[node]
            elif leaf is not None:
                complete = False
                unit = {
                    name: random.random() if unit_value is None else unit_value
                    for name in leaf.domains
                }
                guess = {
                    name: np.asarray(
                        domain.from_unit(jnp.full(domain.size, unit[name], jnp.float32))
                    )
                    for name, domain in leaf.domains.items()
                }
                values[node] = self._drawn(leaf, guess, values.__getitem__)
            else:
                values[node] = law(node).sampleGiven(values)
            if leaf is not None:
                features.update(leaf.invert(values[node], values.__getitem__))
        return features, complete


def _draws(drawn: Any) -> bool:
    distribution = sys.modules["scenic.core.distributions"].Distribution
    return isinstance(drawn, distribution) and kind_of(drawn) not in COMPUTED


def _mutates(node: Any) -> bool:
    scale = field(node, "mutationScale")
    return scale is not None and (is_random(scale) or scale != 0)


def _plain(value: Any) -> Any:
    is_number = isinstance(value, np.ndarray | np.generic) and np.ndim(value) == 0
    return value.item() if is_number else value


def digest(*texts: str) -> int:
    """Return a seed of 32 bits that depends on all of these texts."""
    return int.from_bytes(hashlib.blake2b("/".join(texts).encode(), digest_size=4).digest(), "big")


def _seed_generators(seed: int) -> None:
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - what Scenic draws from


class _seeded_generators:
    """Both global generators with a seed, and as they were afterwards."""

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def __enter__(self) -> None:
        self._states = random.getstate(), np.random.get_state()  # noqa: NPY002
        _seed_generators(self.seed)

    def __exit__(self, *error: object) -> None:
        random.setstate(self._states[0])
        np.random.set_state(self._states[1])  # noqa: NPY002
