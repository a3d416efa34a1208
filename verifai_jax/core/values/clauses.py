"""The form of the data on one simulation that `mtl` gives to searches besides the robustness.

- Clauses: the parts of a requirement that have values of their own; `mtl.clauses` computes them.
- An outcome, `OUTCOME` numbers: the number of the predicate that decides the robustness, its
  instant as a share of the trace, and the shape of the trace: the mean of each of the first
  `SIGNALS` signals (those of the formulas first) over each of `SEGMENTS` equal parts of the time.
  Numbers of signals that do not exist are zero.
"""

CLAUSES = 4
"""Clauses with values of their own at most; the last one joins those beyond."""
ABSENT = -1e9
"""The value of a clause that a goal does not have: broken, whatever happens."""
SIGNALS = 4
"""Signals whose shape is described, each component of a vector counted."""
SEGMENTS = 8
"""Parts of the time of a trace over which a signal is averaged."""
OUTCOME = 2 + SIGNALS * SEGMENTS
"""Numbers of an outcome."""
