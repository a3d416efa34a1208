"""`scenic`: a Scenic program as a feature space and a function of JAX."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from verifai_jax.addons.scenic.compilation import ProgramError
from verifai_jax.addons.scenic.outputs import Outputs
from verifai_jax.addons.scenic.program import ScenicProgram
from verifai_jax.addons.scenic.recipe import Recipe
from verifai_jax.addons.scenic.requirements import Constraint
from verifai_jax.addons.scenic.sampling import Sampling
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.features import Categorical, FeatureSpace
from verifai_jax.features.domain import Domain

MIN_CHANCE = 2e-6
"""Probability of a soft requirement to be off, or on, at least."""
FAST, SLOW = 16_384, 1024
"""Points from which the weights of soft requirements are fitted, compiled and in Python."""
ROUNDS = 200
"""Rounds of that fit at most."""


@suggests_options
def scenic(
    program: str | Path,
    *,
    mode2D: bool = True,
    params: Mapping[str, Any] | None = None,
    model: str | None = None,
    scenario: str | None = None,
    features: Mapping[str, Domain] | None = None,
) -> ScenicProgram:
    """Compile a Scenic program to a feature space and a JAX function.

        scene = vj.scenic("cones.scenic", params={"weather": "rain"})
        vj.Problem("cones", space=scene.space, system=scene.system(simulate), spec="always gap > 1")

    Each random value becomes a feature, with the name of the property or parameter that it sets,
    through its inverse cumulative distribution. Values without an inverse (mutations, points in
    random or non-polygonal regions, custom distributions) share a coordinate `seed`; it is the only
    one for a program that draws nothing before it runs. A soft requirement, `require[p]`, is an
    on/off feature; it is on with probability p among the accepted scenes, as in Scenic.

    **Arguments:**
    - `program`: path of a `.scenic` file, or the code of a program.
    - `mode2D`: whether to use Scenic's planar mode. In three dimensions features are the same, but
      Scenic computes every scene in Python.
    - `params`: global parameters to override.
    - `model`: Scenic module to use as the world model.
    - `scenario`: name of the modular scenario to compile, if there are several.
    - `features`: domains by name, in addition to the random values of the program. The program
      reads their values as global parameters while it runs: with `{"push": vj.Reactive({"gap": (0,
      50)})}` a behavior calls `globalParameters.push(gap=...)` at each step, and a search learns
      how to react.
    **Raises:** `MissingExtra` without Scenic; `ProgramError` for a program that does not compile,
    with Scenic's message, file and line, and for one without random values; `ValueError` for a
    feature whose name the program uses.
    """
    recipe = Recipe.of(program, mode2D, params or {}, model, scenario)
    compiled, sampling = recipe.compiled()
    features = features or {}
    taken = sorted({*features} & {*sampling.domains, *compiled.scenario.params})
    if taken:
        raise ValueError(f"the program has a value {taken[0]!r} already: give another name")
    if not sampling.domains and not features:
        raise ProgramError(
            f"{compiled.filename} draws nothing at random, and is static (no behavior, compose "
            "block, monitor, record, end or simulator), so it has a single scene and no feature: "
            "write Range(1, 2) where a number may vary"
        )
    constraint = Constraint(sampling, compiled, mode2D)
    outputs = Outputs(sampling, mode2D)
    domains = dict(sampling.domains)
    if sampling.soft:
        domains.update(_soft_domains(domains, constraint, sampling))
    domains.update(features)
    constrained = bool(constraint.compiled or constraint.by_scenic or constraint.draws)
    return ScenicProgram(
        space=FeatureSpace(domains, constraint if constrained else None),
        objects=outputs.objects,
        seeded=tuple(sampling.seeded.values()),
        in_python=outputs.in_python,
        by_scenic=constraint.by_scenic,
        scenario=compiled.scenario,
        _recipe=recipe,
        _sampling=sampling,
        _outputs=outputs,
        _constraint=constraint,
    )


def _soft_domains(
    domains: Mapping[str, Domain], constraint: Constraint, sampling: Sampling
) -> dict[str, Domain]:
    """Return the features of soft requirements, weighted so that each is on as often as in Scenic.

    Scenic switches them once a scene, before it refuses anything. Here a point is refused together
    with its switches, so a requirement that is on would come too rarely; its weight corrects that.
    The weights are fitted on samples (iterative proportional fitting of the switches).
    """
    names = list(sampling.soft)
    even = {**domains, **{name: Categorical(False, True) for name in names}}
    space = FeatureSpace(even, constraint)
    count = SLOW if constraint.by_scenic or constraint.draws else FAST
    u = np.random.default_rng(0).random((count, space.dim), np.float32)
    accepted = np.asarray(space.accepts_points(u))
    features = space.features_at(u)
    on = np.stack([np.asarray(features[name]) for name in names], axis=1)[accepted]
    wanted = np.clip(
        [float(sampling.soft[name].prob) for name in names], MIN_CHANCE, 1 - MIN_CHANCE
    )
    weights = wanted.copy()
    for _ in range(ROUNDS if len(on) else 0):
        mass = np.prod(np.where(on, weights, 1 - weights), axis=1)
        share = np.clip((mass[:, None] * on).sum(0) / mass.sum(), MIN_CHANCE, 1 - MIN_CHANCE)
        odds = weights / (1 - weights) * (wanted / (1 - wanted)) / (share / (1 - share))
        weights = np.clip(odds / (1 + odds), MIN_CHANCE, 1 - MIN_CHANCE)
    return {
        name: Categorical(False, True, weights=[float(1 - weight), float(weight)])
        for name, weight in zip(names, weights, strict=True)
    }
