"""The arms of an augmentation: one way each of choosing what is added to the initial set.

    ARMS["counterexamples"](base)           # an Addition

A new arm is a function of a `Base` here, and an entry of `ARMS`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import jax
import numpy as np
import pandas as pd
from jaxtyping import Array, Key

from verifai_jax.addons.analysis import k_closest, pca, random_rows, rules
from verifai_jax.addons.training.augmentation.examples import Examples, Workshop
from verifai_jax.addons.training.augmentation.task import SupervisedTask, TaskError, Weights
from verifai_jax.core.messages.errors import check_names

DRAWN = 2048
"""Features that are drawn at a time while those inside rules are looked for."""
ROUNDS = 64
"""Maximum number of rounds of drawing."""
GENERATED = 20
"""Maximum number of generated inputs for each wrongly predicted input to keep."""


@dataclass(frozen=True, eq=False)
class Base:
    """A trained network, and all data from which an arm may choose: the task and its compiled
    functions; the `weights`; the `initial` examples on which they were trained; the error `table`
    of the search; the number of inputs to add; the key of random choices.
    """

    task: SupervisedTask
    workshop: Workshop
    weights: Weights
    initial: Examples
    table: pd.DataFrame
    added: int
    key: Key[Array, ""]

    @property
    def counterexamples(self) -> pd.DataFrame:
        """Rows of the table on which the network errs."""
        status, violated = self.table["status"], self.table["violated"]
        rows = (status.to_numpy(object) == "ok") & violated.to_numpy(bool)
        return self.table.iloc[np.flatnonzero(rows)]

    def features(self, table: pd.DataFrame) -> pd.DataFrame:
        """Return the feature columns of rows."""
        return table.loc[:, list(self.task.space.columns)].reset_index(drop=True)


@dataclass(frozen=True, eq=False)
class Addition:
    """Features of the inputs that an arm adds, or of the originals for `transformed` inputs of the
    initial set; the number of inputs rendered for the choice; the reason `why` there are fewer than
    requested.
    """

    rows: pd.DataFrame
    rendered: int = 0
    why: str = ""
    transformed: bool = field(default=False)


Arm = Callable[[Base], Addition]


def none(base: Base) -> Addition:
    """Add nothing, to measure the effect of the further training steps alone."""
    return Addition(base.features(base.table.iloc[:0]))


def random(base: Base) -> Addition:
    """Add new inputs, drawn from the prior."""
    rows = base.workshop.draw(base.task.space, base.key, base.added)
    return Addition(rows, base.added)


def standard(base: Base) -> Addition:
    """Add transformed inputs of the initial set, drawn at random."""
    order = jax.random.permutation(base.key, len(base.initial))[: base.added].tolist()
    rows = base.initial.rows.iloc[order].reset_index(drop=True)
    few = f"the initial set has only {len(rows)}" if len(rows) < base.added else ""
    return Addition(rows, 0, few, transformed=True)


def counterexamples(base: Base) -> Addition:
    """Add the counterexamples of the table, in the order in which the search found them."""
    found = base.counterexamples.iloc[: base.added]
    enough = len(found) == base.added
    # The search had to simulate no further than the last of them.
    rendered = int(found.index[-1]) + 1 if enough else len(base.table)
    return Addition(base.features(found), rendered, _few(base))


def table_random(base: Base) -> Addition:
    """Add counterexamples of the table, drawn at random."""
    if not len(base.counterexamples):
        return _nothing(base)
    chosen = random_rows(base.table, base.added, base.key, space=base.task.space)
    return Addition(base.features(chosen.table), len(base.table), _few(base))


def table_closest(base: Base) -> Addition:
    """Add the counterexamples that are closest to each other."""
    if not len(base.counterexamples):
        return _nothing(base)
    chosen = k_closest(base.table, base.added, space=base.task.space)
    return Addition(base.features(chosen.table), len(base.table), _few(base))


def table_pca(base: Base) -> Addition:
    """Add new inputs along the principal components of the counterexamples."""
    return _generated(base, _pca_generator(base))


def rules_(base: Base) -> Addition:
    """Add new inputs, drawn from the prior inside the rules of the table."""
    return _generated(base, _rules_generator(base), "the rules cover too little of the space")


def pca_kept(base: Base) -> Addition:
    """Generate inputs along principal components, and add those on which the network errs."""
    return _kept(base, _pca_generator(base))


def rules_kept(base: Base) -> Addition:
    """Generate inputs inside the rules, and add those on which the network errs."""
    return _kept(base, _rules_generator(base))


ARMS: dict[str, Arm] = {
    "none": none, "random": random, "standard": standard, "counterexamples": counterexamples,
    "table_random": table_random, "table_closest": table_closest, "table_pca": table_pca,
    "rules": rules_, "pca_kept": pca_kept, "rules_kept": rules_kept,
}  # fmt: skip
"""Arms by name."""
FROM_TABLE = tuple(name for name in ARMS if name not in ("none", "random", "standard"))
"""Arms that need the error table."""


def check_arms(arms: tuple[str, ...], task: SupervisedTask) -> None:
    """Check the names of arms, and that the task has the parts that they need.

    **Raises:** `UnknownNameError` with the nearest names; `ValueError` for no arms, or a name
    given twice; `TaskError` for the arm `standard` of a task without a transformation.
    """
    if not arms:
        raise ValueError(f"name at least one arm of {', '.join(ARMS)}")
    check_names("arm", arms, ARMS)
    twice = next((arm for arm in arms if arms.count(arm) > 1), None)
    if twice is not None:
        raise ValueError(f"arm {twice!r} is named twice")
    if "standard" in arms and task.transform is None:
        raise TaskError(
            f"the arm 'standard' transforms inputs, and task {task.name!r} has no transformation: "
            "give it transform=, or leave the arm out"
        )


Generator = Callable[[Key[Array, ""], int], pd.DataFrame]


def _pca_generator(base: Base) -> Generator | str:
    """Return a generator of features, or the reason why it is missing."""
    if not len(base.counterexamples):
        return _few(base)
    try:
        components = pca(base.table, space=base.task.space)
    except ValueError as error:
        return str(error)

    def generate(key: Key[Array, ""], count: int) -> pd.DataFrame:
        return base.features(components.generate(key, count))

    return generate


def _rules_generator(base: Base) -> Generator | str:
    found = base.counterexamples
    if not len(found) or len(found) == len(base.table):
        return _few(base) if not len(found) else "every row of the table is a counterexample"
    described = rules(base.table)
    if not described.rules:
        return str(described)

    def generate(key: Key[Array, ""], count: int) -> pd.DataFrame:
        parts: list[pd.DataFrame] = []
        for now in jax.random.split(key, ROUNDS):
            drawn = base.workshop.draw(base.task.space, now, DRAWN)
            parts.append(drawn.loc[described.matches(drawn)])
            if sum(map(len, parts)) >= count:
                break
        return pd.concat(parts, ignore_index=True).iloc[:count]

    return generate


def _generated(base: Base, generate: Generator | str, few: str = "") -> Addition:
    if isinstance(generate, str):
        return _nothing(base, generate)
    rows = generate(base.key, base.added)
    few = few if len(rows) < base.added else ""
    return Addition(rows, len(base.table) + len(rows), few)


def _kept(base: Base, generate: Generator | str) -> Addition:
    if isinstance(generate, str):
        return _nothing(base, generate)
    maximum = GENERATED * base.added
    parts, generated, found = [base.features(base.table.iloc[:0])], 0, 0
    key = base.key
    while found < base.added and generated < maximum:
        key, now = jax.random.split(key)
        rows = generate(now, base.added)
        if not len(rows):
            break
        wrong = base.workshop.judge(base.weights, base.workshop.render(rows)).wrong
        parts.append(rows.loc[wrong])
        generated, found = generated + len(rows), found + int(wrong.sum())
    rows = pd.concat([part for part in parts if len(part)] or parts[:1], ignore_index=True)
    few = f"only {found} of {generated} generated inputs are wrong" if found < base.added else ""
    return Addition(rows.iloc[: base.added], len(base.table) + generated, few)


def _few(base: Base) -> str:
    """Write the number of counterexamples if it is lower than requested."""
    found, rows = len(base.counterexamples), len(base.table)
    if found >= base.added:
        return ""
    return f"the error table has {found or 'no'} counterexample{'s' * (found != 1)} in {rows} rows"


def _nothing(base: Base, why: str | None = None) -> Addition:
    rows = base.features(base.table.iloc[:0])
    return Addition(rows, len(base.table), _few(base) if why is None else why)
