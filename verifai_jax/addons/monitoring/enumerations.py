"""Columns of words as truth values, and formulas that compare a column with a word.

word_columns("mode", ["OFF", "AUTO"])           # {"mode=AUTO": [False, True], "mode=OFF": ...}
with_words([formula], trace)                    # `mode == "AUTO"` means the signal "mode=AUTO"
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from verifai_jax.addons.monitoring.columns import GAPS, TRUTHS, reads_as_number
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.expression import Signal
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.rewriting import replaced

MAX_WORDS, MAX_LENGTH = 64, 64
"""Maximum count of different words of a column, and of characters of one; others are comments."""


def word_columns(
    name: str, cells: Sequence[str | None], other: Sequence[bool] | None = None
) -> dict[str, np.ndarray]:
    """Return the truth values of a column of words, of each word whether the column has it.

    Words such as `ON` and `OFF` alone are the truth values of the column itself.

    **Arguments:**
    - `other`: for a column whose words are known to be values, which cells have another value.
    **Raises:** `ValueError` for a column that has numbers, too many or too long words, or none.
    """
    words = np.array([(cell or "").strip() for cell in cells], object)
    given = np.array([word not in GAPS for word in words.tolist()], bool)
    known = given if other is None else given | np.asarray(other, bool)
    distinct = sorted(set(words[given].tolist()))
    fits = 0 < len(distinct) <= MAX_WORDS and max(map(len, distinct)) <= MAX_LENGTH
    # Words of which none comes twice are remarks.
    fits = fits and (other is not None or len(distinct) < given.sum())
    if not fits or any(reads_as_number(word) for word in distinct):
        raise ValueError(f"column {name!r} has no words that can be values")

    def column(truths: np.ndarray) -> np.ndarray:
        # Masked, so that a trace knows truth values with gaps for what they are.
        return truths if known.all() else np.ma.array(truths, mask=~known)

    if all(word in TRUTHS for word in distinct):
        return {name: column(np.isin(words, [w for w in distinct if TRUTHS[w]]))}
    return {f"{name}={word}": column((words == word) & given) for word in distinct}


def with_words(formulas: Sequence[Formula], trace: Trace) -> tuple[list[Formula], Trace]:
    """Return formulas in which comparisons with words are signals, and the trace with all of them.

    A word that a column never has is false throughout, with a note.
    """
    signals, truths, notes = dict(trace.signals), set(trace.truths), dict(trace.notes)
    made = []
    for formula in formulas:
        parts: dict[Formula, Formula] = {}
        for part in formula.subformulas():
            if not isinstance(part, ast.Predicate) or part.comparison not in ("==", "!="):
                continue
            for column, word in ((part.left, part.right), (part.right, part.left)):
                if type(column) is not Signal or type(word) is not Signal:
                    continue
                name, begin = f"{column.name}={word.name}", f"{column.name}="
                words = [each for each in trace.signals if each.startswith(begin)]
                if name not in trace.signals and (word.name in trace.signals or not words):
                    continue
                if name not in signals:
                    like = np.asarray(signals[words[0]])
                    signals[name] = np.where(np.isnan(like), np.nan, 0.0)
                    truths.add(name)
                    had = ", ".join(repr(each.removeprefix(begin)) for each in words)
                    notes[f"{column.name!r} is never {word.name!r}, but {had}"] = 1
                test = ast.Atom(Signal(name))
                parts[part] = test if part.comparison == "==" else ast.Not(test)
                break
        made.append(replaced(formula, parts) if parts else formula)
    if signals.keys() == trace.signals.keys():
        return made, trace
    return made, replace(trace, signals=signals, truths=frozenset(truths), notes=notes)
