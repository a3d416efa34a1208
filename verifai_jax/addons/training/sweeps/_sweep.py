"""Sweeps: train many configurations and rank the policies by their certified safety.

    result = sweep(study, search="halton", configurations=32)
    result = sweep(study, search="bayes", configurations=64, folder="sweeps/mine")  # resumable

A sweep is a deterministic function of computations that are cached one by one: a training up to a
checkpoint, the return of a policy, a part of a certification. Killed at any moment and called again
with the same folder, it reads the finished ones, computes the rest, and gives the same table.
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from verifai_jax.addons.estimation.certification import Certification
from verifai_jax.addons.estimation.certification.attack import check_attack
from verifai_jax.addons.rl._evaluate import EPISODES
from verifai_jax.addons.training.sweeps.clock import Clock
from verifai_jax.addons.training.sweeps.fingerprint import fingerprint
from verifai_jax.addons.training.sweeps.halving import Halving
from verifai_jax.addons.training.sweeps.optuna import OptunaSampler
from verifai_jax.addons.training.sweeps.population import Population
from verifai_jax.addons.training.sweeps.proposers import make_proposer
from verifai_jax.addons.training.sweeps.result import Sweep
from verifai_jax.addons.training.sweeps.running import RunningSweep
from verifai_jax.addons.training.sweeps.study import Study, StudyError
from verifai_jax.addons.training.sweeps.trainer import STEPS, FunctionTrainer
from verifai_jax.core.messages.checks import check_count, options_of
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.core.store.cache import locked_cache
from verifai_jax.core.user_code.callbacks import Callback, check_callbacks
from verifai_jax.evaluation.run_on import RunOn
from verifai_jax.search import Search
from verifai_jax.statistics.stopping import Stop


@suggests_options
def sweep(
    study: Study, search: str | Search | OptunaSampler | Population = "halton",
    configurations: int = 32, *,
    seed: int = 0, certification: Certification | None = None, halving: Halving | None = None,
    batch: int | None = None, episodes: int = EPISODES, stop: Stop | None = None,
    folder: str | Path | None = None, run_on: RunOn | None = None,
    note: Mapping[str, Any] | None = None, callbacks: Iterable[Callback] = (),
    progress: bool | None = None, even_if_changed: bool = False,
) -> Sweep:  # fmt: skip
    """Train configurations of a study's hyper-parameters and certify their policies.

    A row of the result is a policy: a configuration, trained with one seed, at one checkpoint. The
    same seed gives the same table on one machine.

    **Arguments:**
    - `study`: hyper-parameters, trainer and specification.
    - `search`: the search over the hyper-parameters: a name, a `Search`, `"optuna:tpe"`, or an
      `OptunaSampler`. A search that learns proposes in rounds and minimises the failure rate, then
      the worst robustness, then the return. Or a `Population`, whose members change their
      hyper-parameters while they train.
    - `configurations`: maximum number of configurations, or of a population's members; each is
      trained with each of the study's seeds.
    - `seed`: the seed of the search and of the samples; training seeds belong to the study.
    - `certification`: the attack on each policy and the samples of its certificate.
    - `halving`: how to stop all but the best configurations at each checkpoint.
    - `batch`: configurations in a round of a search that learns.
    - `episodes`: number of episodes over which the nominal return is averaged.
    - `folder`: the folder of finished work and the result, which `load_sweep` reads; passing it
      again resumes an interrupted sweep.
    - `stop`: the seconds of the sweep; no training begins after two thirds of them, and the call of
      a training function that has not ended by then is ended, as an error of its row.
    - `note`: plain data stored in the folder next to the work; its `target` names the study.
    - `callbacks`: functions called for each policy when its return is known, and again when its
      safety is, with the number of calls so far and a dictionary of plain numbers; cached work
      counts too.
    - `run_on`: the workers that train and simulate; the table is the same. With `halving`,
      configurations that continue after a checkpoint are trained from the start.
    - `progress`, `even_if_changed`: as in `falsify` and `resume`.
    **Returns:** the policies with their returns and certificates. An interrupted sweep (Ctrl-C, out
    of time) returns its finished part; `record.complete` is False.
    **Raises:** before anything trains, the `StudyError` and `UnknownNameError` of `Study.check`;
    `ValueError` for options out of range and for a search that needs gradients; `UnknownNameError`
    for an unknown search or option; `CacheError` for a folder that is damaged, foreign, of another
    format, or of another sweep.
    """
    certified = options_of("sweep", Certification, certification)
    seconds = options_of("sweep", Stop, stop, "seconds").seconds
    executor = options_of("sweep", RunOn, run_on, "executor").executor
    check_options(study, certified, configurations, seed, halving, batch, episodes)
    called = check_callbacks(callbacks)
    study.check()
    check_attack(study.untrained_problem(), certified.attack)
    population = search if isinstance(search, Population) else None
    if population is not None:
        _check_population(study, halving, batch)
        certified.check_budget(count_policies(study, configurations, None))
        search, batch = population.search, configurations
    proposer = make_proposer(
        search, study.space, configurations=configurations, seed=seed, batch=batch
    )
    attack = certified.attack
    options: dict[str, Any] = {
        "search": proposer.to_json(), "seed": seed, "samples": certified.samples,
        "confidence": certified.confidence, "budget": certified.budget,
        "attack": attack if isinstance(attack, str) else repr(attack),
        "attack_simulations": certified.attack_simulations,
        "halving": None if halving is None else _given(halving), "episodes": episodes,
    }  # fmt: skip
    if population is not None:
        options["population"] = {**asdict(population), "search": proposer.to_json()}
    if proposer.learns or population is not None:
        # Its proposals depend on both.
        options |= {"configurations": configurations, "batch": proposer.batch}
    with locked_cache(folder) as cache, Clock(study.name, seconds, progress) as clock:
        sources = cache.claim(fingerprint(study, options), study.sources(), even_if_changed)
        if note is not None:
            cache.note("command", dict(note))
            options["target"] = note.get("target")
        options |= {"configurations": configurations, "p": study.p}
        options["curve"] = None if study.curve_formula is None else str(study.curve_formula)
        running = RunningSweep(
            study, options, cache, clock, halving, certified, called, executor=executor,
            sources=sources, population=population,
        )  # fmt: skip
        result = Sweep(running.run(proposer), study, reuse=cache.reuse())
    if folder is not None:
        with cache.writing(folder):
            result.save(folder)
    return result


def _given(halving: Halving) -> dict[str, Any]:
    """Return the options of a halving as they are recorded, without those that are left out."""
    return {
        name: value
        for name, value in asdict(halving).items()
        if value is not None and value is not False
    }


def check_options(
    study: object, certified: Certification, configurations: int, seed: int, halving: object,
    batch: int | None, episodes: int,
) -> None:  # fmt: skip
    """Check the options of a sweep, separately and against its study.

    **Raises:** `TypeError` for an argument that is not a study or a `Halving`; `ValueError` for a
    number out of range, or a budget that cannot sample all policies; `StudyError` for halving
    without checkpoints or with trainings of different lengths.
    """
    if not isinstance(study, Study):
        raise TypeError(f"sweep needs a Study; got {study!r}")
    counts = {"configurations": configurations, "episodes": episodes}
    if batch is not None:
        counts["batch"] = batch
    for name, value in counts.items():
        check_count(name, value)
    check_count("seed", seed, 0)
    halved = None if halving is None else _check_halving(study, halving)
    certified.check_budget(count_policies(study, configurations, halved))


def count_policies(study: Study, configurations: int, halving: Halving | None) -> int:
    """Return the maximum number of rows of a sweep."""
    several_lengths = STEPS in study.space.domains
    checkpoints = 1 + sum(several_lengths or at < study.trainer.steps for at in study.checkpoints)
    left, total = configurations, 0
    if halving is not None and halving.until_safe:
        checkpoints = 1  # Only the last policy of a training is certified.
    for _ in range(checkpoints):
        total += left
        left = left if halving is None else halving.survivors(left)
    return total * len(study.training_seeds)


def _check_halving(study: Study, halving: object) -> Halving:
    if not isinstance(halving, Halving):
        raise TypeError(f"halving must be a Halving; got {halving!r}")
    _check_checkpoints(study, "halving")
    return halving


def _check_checkpoints(study: Study, what: str) -> None:
    if STEPS in study.space.domains:
        raise StudyError(
            f"{what} compares trainings of one length at their checkpoints; "
            "take steps out of the space"
        )
    if not [at for at in study.checkpoints if at < study.trainer.steps]:
        raise StudyError(
            f"{what} stops trainings at checkpoints; the study has none before the end at "
            f"{study.trainer.steps} steps"
        )


def _check_population(study: Study, halving: Halving | None, batch: int | None) -> None:
    _check_checkpoints(study, "a population")
    if isinstance(study.trainer, FunctionTrainer):
        raise StudyError(
            "a population goes on with other hyper-parameters, for which it needs a task and an "
            f"algorithm; {study.trainer.name} is a training function"
        )
    if halving is not None and halving.reduction > 1:
        raise ValueError(f"a population keeps its size: give reduction=1; got {halving.reduction}")
    if batch is not None:
        raise ValueError(f"a population is one round of all configurations; got batch={batch}")
