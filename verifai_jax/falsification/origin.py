"""Where the rows of a run come from, as one value that says why there is no failure rate.

origin_of(search, first=0)         "prior", "first", "given", "sequence", "coverage", "learned"
"""

from typing import Literal, get_args

from verifai_jax.search import PointList, Search

Origin = Literal["prior", "first", "given", "sequence", "coverage", "learned"]
"""Where rows come from: independent samples of the prior; such samples after rows that were given;
given rows alone; a sequence that spreads its points, in all features or some; a search guided by
coverage; a search guided by robustness."""
ORIGINS: tuple[Origin, ...] = get_args(Origin)


def origin_of(search: Search, first: int) -> Origin:
    """Return where the rows of a run come from.

    **Arguments:**

    - `search`: of the run.
    - `first`: number of rows that were given before the search proposed any.
    """
    if search.samples_prior:
        return "first" if first else "prior"
    if isinstance(search, PointList):
        return "given"
    if not search.learns:
        return "sequence"
    return "coverage" if search.wants_marks else "learned"
