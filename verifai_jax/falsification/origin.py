"""Where the rows of a run come from, as one value that says why there is no failure rate.

origin_of(search, first=0)         "prior", "first", "given", "sequence", "coverage", "learned"
"""

from typing import Literal

from verifai_jax.search import Search

Origin = Literal["prior", "first", "given", "sequence", "coverage", "learned"]
"""Where rows come from: as the points of a search (`search/base.py`), and `"first"` for samples of
the prior after rows that were given."""


def origin_of(search: Search, first: int) -> Origin:
    """Return where the rows of a run come from.

    **Arguments:**

    - `search`: the search of the run.
    - `first`: number of rows that were given before the search proposed any.
    """
    return "first" if first and search.samples_prior else search.origin
