"""Random formulas with their robustness by definition, on random traces."""

from collections.abc import Iterator

import numpy as np

from verifai_jax import mtl

DT = 0.5
Tree = tuple[object, ...]
"""A formula: an operator, its window or its bound, and its parts."""


def _random_tree(rng: np.random.Generator, depth: int) -> Tree:
    if depth == 0:
        sign = ">" if rng.random() < 0.5 else "<"
        return sign, rng.choice(["x", "y"]), float(rng.integers(-3, 4))
    kind = str(rng.choice(["always", "eventually", "until", "and", "or", "not", "->"]))
    low = int(rng.integers(0, 3))
    window = (low, low + int(rng.integers(0, 4)))
    count = 2 if kind in ("until", "and", "or", "->") else 1
    return (kind, window, *(_random_tree(rng, depth - 1) for _ in range(count)))


def _text(tree: Tree) -> str:
    kind, window, *parts = tree
    if kind in ("<", ">"):
        return f"({window} {kind} {parts[0]:zg})"
    inner = [_text(part) for part in parts if isinstance(part, tuple)]
    assert isinstance(window, tuple)
    ends = f"[{window[0] * DT:zg}, {window[1] * DT:zg}]"
    if kind in ("always", "eventually", "not"):
        return f"({kind}{'' if kind == 'not' else ends} {inner[0]})"
    return f"({inner[0]} {kind}{ends if kind == 'until' else ''} {inner[1]})"


def brute(tree: Tree, signals: dict[str, np.ndarray], i: int) -> float:
    """Return the robustness at a sample by the definition; after the end the last sample holds."""
    kind, window, *parts = tree
    if kind in ("<", ">"):
        value = float(signals[str(window)][min(i, len(signals["x"]) - 1)])
        bound = parts[0]
        assert isinstance(bound, float)
        return value - bound if kind == ">" else bound - value

    def at(part: object, k: int) -> float:
        assert isinstance(part, tuple)
        return brute(part, signals, k)

    assert isinstance(window, tuple)
    ahead = range(i + window[0], i + window[1] + 1)
    if kind == "always":
        return min(at(parts[0], k) for k in ahead)
    if kind == "eventually":
        return max(at(parts[0], k) for k in ahead)
    if kind == "until":
        return max(min([at(parts[1], k), *(at(parts[0], j) for j in range(i, k))]) for k in ahead)
    left = at(parts[0], i)
    if kind == "not":
        return -left
    right = at(parts[1], i)
    return {"and": min(left, right), "or": max(left, right)}.get(str(kind), max(-left, right))


def random_formulas(seed: int) -> Iterator[tuple[mtl.Formula, Tree, dict[str, np.ndarray]]]:
    """Yield formulas, their trees, and signals `x` and `y` of five samples."""
    rng = np.random.default_rng(seed)
    for _ in range(24):
        tree = _random_tree(rng, 2)
        values = {name: rng.integers(-4, 5, 5).astype(float) for name in ("x", "y")}
        yield mtl.parse(_text(tree)), tree, values
