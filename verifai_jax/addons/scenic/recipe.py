"""A Scenic program by its text and options, which other processes can compile for themselves."""

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from verifai_jax.addons.scenic.compilation import Compiled, compile_program
from verifai_jax.addons.scenic.sampling import Sampling


@dataclass(frozen=True)
class Recipe:
    """The text and options of a program, from which any process can compile it.

    - `program`: the path or the code.
    - `planar`: Scenic's `mode2D`.
    - `params`: names and values of overridden parameters.
    - `model`, `scenario`: as in `scenic`.
    """

    program: str
    planar: bool
    params: tuple[tuple[str, Any], ...]
    model: str | None
    scenario: str | None

    @classmethod
    def of(
        cls, program: str | Path, planar: bool, params: Mapping[str, Any], model: str | None,
        scenario: str | None,
    ) -> "Recipe":  # fmt: skip
        """Return a recipe that works in any process and working directory."""
        text = str(program)
        if "\n" not in text and Path(text).is_file():
            text = str(Path(text).resolve())
        return cls(text, planar, tuple(params.items()), model, scenario)

    def compiled(self) -> tuple[Compiled, Sampling]:
        """Return the program compiled in this process, once."""
        return compiled_recipe(_Key(self))


class _Key:
    """A recipe by its identity where its parameters cannot be hashed."""

    def __init__(self, recipe: Recipe) -> None:
        self.recipe = recipe
        self._text = repr(recipe)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and other._text == self._text

    def __hash__(self) -> int:
        return hash(self._text)


@functools.lru_cache(maxsize=8)
def compiled_recipe(key: _Key) -> tuple[Compiled, Sampling]:
    """Compile the program of a recipe; the latest results are cached."""
    recipe = key.recipe
    compiled = compile_program(
        recipe.program, recipe.planar, dict(recipe.params), recipe.model, recipe.scenario
    )
    return compiled, Sampling(compiled)
