"""`verifai-jax sweep specs/mountain_car.py:safe_training --configurations 32`."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from verifai_jax.cli.arguments import (
    MAX_SECONDS,
    PICTURES,
    SET,
    next_folder,
    plain_values,
    refuse_with_resume,
    split_names,
)

_FIXED = (
    "search",
    "seed",
    "samples",
    "confidence",
    "budget",
    "attack",
    "attack_simulations",
    "reduction",
    "by",
    "only",
)
_SHOWN = 12
"""Rows of the table that are printed."""


@click.command()
@click.argument("target", required=False)
@click.option("--configurations", type=int, help="How many, at most  [default: 32]")
@click.option("--search", help="Of the hyper-parameters: a name, or optuna:tpe  [default: halton]")
@SET
@click.option("--seed", type=int, help="Of the search and the samples  [default: 0]")
@click.option("--samples", type=int, help="Simulations of a policy at most  [default: 512]")
@click.option("--confidence", type=float, help="Of all verdicts together  [default: 0.95]")
@click.option("--budget", type=int, help="Simulations of the certification in all.")
@click.option("--attack", help="Search that attacks each policy  [default: cross_entropy]")
@click.option("--attack-simulations", type=int, help="Of each policy's attack  [default: 256]")
@click.option("--halving", "reduction", type=float, help="Of so many configurations one goes on.")
@click.option("--halving-by", "by", help="return or safety  [default: return]")
@click.option("--only", metavar="NAMES", help="Hyper-parameters to vary, comma-separated.")
@click.option(
    "--nominal", multiple=True, metavar="NAME=VALUE", help="Where --only holds the others."
)
@MAX_SECONDS
@click.option("--store", type=click.Path(path_type=Path), help="Remembers work [in the folder].")
@click.option("--resume", type=click.Path(path_type=Path), help="Folder of a sweep to go on with.")
@click.option(
    "--folder",
    type=click.Path(path_type=Path),
    help="Folder to write  [default: sweeps/NAME-1, -2, ...]",
)
@PICTURES
def sweep(
    target: str | None,
    configurations: int | None,
    options: tuple[str, ...],
    nominal: tuple[str, ...],
    max_seconds: float | None,
    store: Path | None,
    resume: Path | None,
    folder: Path | None,
    pictures: bool,
    **asked: Any,
) -> None:
    """Train configurations of the study TARGET (specs/FILE.py:NAME), certify what they learn."""
    from verifai_jax.core.targets import load_target, target_of_project
    from verifai_jax.sweeps._sweep import sweep as run_sweep
    from verifai_jax.sweeps.study import Study

    if resume is not None:
        renamed = {"reduction": "halving", "by": "halving-by"}
        fixed = {f"--{renamed.get(name, name)}": asked[name] for name in _FIXED}
        refuse_with_resume(
            {**fixed, "--set": options, "--nominal": nominal, "--folder": folder}, "sweep"
        )
        folder, store = resume, resume if store is None else store
        before = _before(store)
        target = target or target_of_project(
            before["target"],
            resume,
            kind="study",
            remedy="specs/FILE.py:NAME --resume ...",
        )
        asked, configurations = before["asked"], configurations or before["configurations"]
        options, nominal = tuple(before["options"]), tuple(before["nominal"])
    if target is None:
        raise click.UsageError("Missing argument 'TARGET', such as specs/mountain_car.py:NAME.")
    configurations = 32 if configurations is None else configurations
    study = load_target(target, Study)
    if asked["only"] is not None:
        study = study.only(*split_names(asked["only"]), nominal=plain_values("--nominal", nominal))
    folder = folder or next_folder("sweeps", study.name)
    how = _understood(asked, options)
    memory = folder if store is None else store
    # What a later --resume needs to know.
    note = {
        "target": target,
        "configurations": configurations,
        "asked": asked,
        "options": list(options),
        "nominal": list(nominal),
    }
    found = run_sweep(
        study,
        configurations=configurations,
        store=memory,
        max_seconds=max_seconds,
        note=note,
        **how,
    )
    record = replace(found.record, options={**found.record.options, "target": target})
    found = replace(found, record=record)
    click.echo(str(found))
    if len(found.table):
        click.echo(_told(found))
    found.save(folder)
    click.echo(f"  table        {folder / 'table.parquet'}")
    if pictures and record.certified:
        picture = folder / "sweep.png"
        found.plot(picture)
        click.echo(f"  picture      {picture}")
    if not record.complete:
        click.echo(f"  go on        verifai-jax sweep --resume {folder}")


def _understood(asked: dict[str, Any], options: tuple[str, ...]) -> dict[str, Any]:
    """Return the keywords of the sweep."""
    from verifai_jax.search import named
    from verifai_jax.sweeps.halving import Halving

    how = {
        name: asked[name]
        for name in ("seed", "samples", "confidence", "budget", "attack", "attack_simulations")
        if asked[name] is not None
    }
    search, given = asked["search"] or "halton", plain_values("--set", options)
    if search.startswith("optuna:"):
        from verifai_jax.sweeps.optuna import OptunaSampler

        how["search"] = OptunaSampler(search.removeprefix("optuna:"), given)
    else:
        how["search"] = named(search, **given)
    if asked["reduction"] is not None:
        how["halving"] = Halving(asked["reduction"], asked["by"] or "return")
    elif asked["by"] is not None:
        raise click.UsageError("--halving-by goes with --halving")
    return how


def _before(store: Path) -> dict[str, Any]:
    """Read the options of the sweep that a store remembers."""
    from verifai_jax.sweeps.cache import Store, StoreError, store_file

    if not store_file(store).exists():
        raise FileNotFoundError(f"no sweep to go on with in {store}")
    with Store(store) as kept:
        note = kept.note("command")
    if note is None:
        raise StoreError(f"{store} is not of this command; call sweep(..., store=...) again")
    return note


def _told(found: Any) -> str:
    """Write the first rows, the ones to choose first, as text."""
    from verifai_jax.sweeps.ranking import chosen_first

    table = found.table
    order = list(chosen_first(table))
    order += [i for i in range(len(table)) if i not in set(order)]
    names = [n for n in found.hyperparameters if n in table and n != "steps"]
    columns = ["steps", *names, "nominal_return", "failures", "simulations", "failure_high"]
    some = table.iloc[order[:_SHOWN]][[*columns, "worst_robustness", "verdict", "status"]]
    if (some["status"] == "trained").all():
        some = some.drop(columns="status")
    text = some.to_string(float_format=lambda value: f"{value:.4g}", max_colwidth=40)
    left = len(table) - len(some)
    return text if not left else f"{text}\n  and {left} more in the table"
