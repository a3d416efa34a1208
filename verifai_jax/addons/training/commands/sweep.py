"""`verifai-jax sweep specs/mountain_car.py:safe_training --configurations 32`."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from verifai_jax.cli import arguments
from verifai_jax.cli.arguments import PATH, option
from verifai_jax.cli.exit_codes import BROKEN, CommandError
from verifai_jax.cli.gates import Gate, check_gate, fail_on
from verifai_jax.cli.json_output import command, draw, give_result, say
from verifai_jax.cli.next_folder import given_or_next

if TYPE_CHECKING:
    from verifai_jax import Sweep
_RESUMES = (
    *("resume", "target", "configurations", "max_seconds", "cache", "even_if_changed", "cluster"),
    "fail_on",
)
"""Options that go with `--resume`; the cache of the sweep has fixed the others."""
_NOTED = ("target", "configurations", "given", "options", "nominal")
"""Entries of the command in the cache."""
_MAX_ROWS = 12
"""Rows of the table that are printed."""


@command()
@click.argument("target", required=False)
@option("--configurations", type=int, help="Maximum configurations  [default: 32]")
@option("--search", help="Name of the search, population, or optuna:tpe  [default: halton]")
@arguments.SET
@option("--seed", type=int, help="Seed of the search and the samples  [default: 0]")
@option("--samples", type=int, help="Minimum number of samples of each policy  [default: 512]")
@option("--confidence", type=float, help="Confidence of all verdicts together  [default: 0.95]")
@option("--budget", type=int, help="Simulations of the certification in all.")
@option("--attack", help="Search that attacks each policy  [default: cross_entropy]")
@option("--attack-simulations", type=int, help="Simulations of each attack  [default: 256]")
@option("--halving", "reduction", type=float,
        help="The share of configurations that continue is one in this many.")  # fmt: skip
@option("--halving-by", "by", help="Criterion: return or safety  [default: return]")
@option("--only", metavar="NAMES", help="Hyper-parameters to vary, comma-separated.")
@option("--nominal", multiple=True, metavar="NAME=VALUE",
        help="Value of a hyper-parameter that --only fixes.")  # fmt: skip
@arguments.MAX_SECONDS
@option("--cache", type=PATH, help="Folder of finished work  [default: the sweep's folder]")
@option("--resume", type=PATH, help="Folder of a sweep to resume.")
@arguments.EVEN_IF_CHANGED
@option("--folder", type=PATH, help="Folder to write  [default: sweeps/NAME-1, -2, ...]")
@arguments.CLUSTER
@arguments.PICTURES
@fail_on(unsafe="unless a policy is shown to be safe")
def sweep(
    target: str | None, configurations: int | None, options: tuple[str, ...],
    nominal: tuple[str, ...], max_seconds: float | None, cache: Path | None, resume: Path | None,
    even_if_changed: bool, folder: Path | None, cluster: str | None, pictures: bool,
    fail_on: Gate | None, **given: Any,
) -> None:  # fmt: skip
    """Train configurations of the study TARGET (specs/FILE.py:NAME), certify their policies."""
    from verifai_jax import RunOn, Stop, Study
    from verifai_jax.addons.training.sweeps._sweep import sweep as run_sweep
    from verifai_jax.core.store.cache import cache_file
    from verifai_jax.core.user_code.targets import load_target, target_of_project

    if resume is not None:
        arguments.refuse_others(_RESUMES, "is fixed in the sweep that --resume goes on with")
        folder, cache = resume, resume if cache is None else cache
        before = _read_command(cache)
        how = {"kind": "study", "remedy": "specs/FILE.py:NAME --resume ..."}
        target = target or target_of_project(before["target"], resume, **how)
        given, configurations = before["given"], configurations or before["configurations"]
        options, nominal = tuple(before["options"]), tuple(before["nominal"])
    if target is None:
        raise click.UsageError("Missing argument 'TARGET', such as specs/mountain_car.py:NAME.")
    configurations = 32 if configurations is None else configurations
    study = load_target(target, Study)
    if given["only"] is not None:
        only, others = given["only"], arguments.plain_values("--nominal", nominal)
        study = study.only(*arguments.split_names(only), nominal=others)
    # Read by a later --resume.
    note = {
        "target": target, "configurations": configurations, "given": given,
        "options": list(options), "nominal": list(nominal),
    }  # fmt: skip
    keywords = _keywords(given, options)
    goes_on = partial(
        _resuming, target=target, cache=cache, max_seconds=max_seconds, cluster=cluster
    )
    kept = cache_file(Path() if cache is None else cache.absolute())
    try:
        with (
            given_or_next(folder, "sweeps", study.name, goes_on, kept) as path,
            arguments.on_cluster(cluster) as executor,
        ):
            folder = path
            result = run_sweep(
                study, configurations=configurations, folder=folder if cache is None else cache,
                stop=Stop(seconds=max_seconds), note=note, run_on=RunOn(executor=executor),
                even_if_changed=even_if_changed, **keywords,
            )  # fmt: skip
            record = result.record
            say(result)
            if len(result.table):
                say(_format_table(result))
            if cache not in (None, folder):
                result.save(folder)
    except KeyboardInterrupt:
        if folder is not None and cache_file(folder if cache is None else cache).exists():
            say(f"  resume       {_resuming(folder, target, cache, max_seconds, cluster)}")
        raise
    say(f"  table        {folder / 'table.parquet'}")
    give_result(
        study=study.name, target=target, policies=result.table,
        safe=[int(row) for row in result.safe.index], complete=record.complete,
        seconds=record.seconds, folder=folder,
    )  # fmt: skip
    if pictures and record.certified:
        draw(result, folder / "sweep.png")
    if not record.complete:
        say(f"  resume       {_resuming(folder, target, cache, max_seconds, cluster)}")
    elif all(status not in ("trained", "stopped") for status in result.table["status"]):
        raise CommandError("no configuration was trained, so nothing is known of any", BROKEN)
    check_gate(fail_on, {"unsafe": not len(result.safe)})


def _resuming(
    folder: Path, target: str, cache: Path | None, max_seconds: float | None, cluster: str | None
) -> str:
    """Write the command that continues a sweep."""
    apart = None if cache == folder else cache
    more = {"--cache": apart, "--max-seconds": max_seconds, "--cluster": cluster}
    return arguments.resuming("sweep", folder, target, more)


def _keywords(given: Mapping[str, Any], options: tuple[str, ...]) -> dict[str, Any]:
    """Turn options of the command into keyword arguments of `sweep`."""
    from verifai_jax import Certification, Halving, Population
    from verifai_jax.core.messages.errors import check_names
    from verifai_jax.search import named

    names = ("samples", "confidence", "budget", "attack", "attack_simulations")
    certified = {name: given[name] for name in names if given[name] is not None}
    keywords: dict[str, Any] = {"certification": Certification(**certified)}
    if given["seed"] is not None:
        keywords["seed"] = given["seed"]
    search, values = given["search"] or "halton", arguments.plain_values("--set", options)
    if search.startswith("optuna:"):
        from verifai_jax import OptunaSampler

        keywords["search"] = OptunaSampler(search.removeprefix("optuna:"), values)
    elif search == "population":
        check_names("option of a population", values, vars(Population()))
        keywords["search"] = Population(**values)
    else:
        keywords["search"] = named(search, **values)
    if given["reduction"] is not None:
        keywords["halving"] = Halving(given["reduction"], given["by"] or "return")
    elif given["by"] is not None:
        raise click.UsageError("--halving-by goes with --halving")
    return keywords


def _read_command(folder: Path) -> dict[str, Any]:
    """Read the command of an interrupted sweep from its cache."""
    from verifai_jax.core.store.cache import Cache, CacheError, cache_file

    if not cache_file(folder).exists():
        raise FileNotFoundError(f"no sweep to resume in {folder}{_describe_folder(folder)}")
    note = Cache(folder).note("command")
    if note is None:
        raise CacheError(
            f"the sweep in {folder} was begun in Python, or its command is damaged: call "
            f"vj.sweep(study, ..., folder={str(folder)!r}) again"
        )
    known = isinstance(note, dict) and {*_NOTED} <= note.keys()
    if not known or not isinstance(note["given"], dict):
        raise CacheError(f"the sweep in {folder} is damaged in its note 'command'")
    return note


def _describe_folder(folder: Path) -> str:
    """Describe a folder without finished work."""
    if (folder / "run.json").is_file():
        goes_on = arguments.resuming("falsify", folder, None, {})
        return f": it is the folder of a run; {goes_on} goes on with it"
    if arguments.is_sweep(folder):
        return ": its finished work is elsewhere; give the same --cache FOLDER as before"
    if not folder.exists():
        return ": there is no such folder"
    return ": verifai-jax sweep has not written it"


def _format_table(result: "Sweep") -> str:
    """Write the most preferable rows of the table."""
    from verifai_jax.addons.training.sweeps.ranking import preference_order
    from verifai_jax.core.messages.text import printable

    table = result.table
    order = list(preference_order(table))
    order += [i for i in range(len(table)) if i not in set(order)]
    names = [n for n in result.hyperparameters if n in table and n != "steps"]
    columns = ["steps", *names, "nominal_return", "failures", "simulations", "failure_high"]
    columns += ["worst_robustness", "verdict", "status"]
    some: Any = table.iloc[order[:_MAX_ROWS]][columns]
    if (some["status"] == "trained").all():
        some = some.drop(columns="status")
    text = some.to_string(float_format=lambda value: f"{value:z.4g}", max_colwidth=40)
    left = len(table) - len(some)
    text = printable(text)
    return text if not left else f"{text}\n  and {left} more in the table"
