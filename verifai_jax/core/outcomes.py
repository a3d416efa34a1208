"""The form of what a search learns of a simulation's outcome, in addition to its robustness.

An outcome is `OUTCOME` numbers: the number of the predicate that decides the robustness, the
instant at which it does as a share of the trace, and the shape of the trace: of each of the first
`SIGNALS` signals, those that the formulas speak of before the others, means over `SEGMENTS` equal
parts of its time. Zero where there are fewer signals.
"""

SIGNALS = 4
"""Signals whose shape is described, each component of a vector counted."""
SEGMENTS = 8
"""Parts of the time of a trace over which a signal is averaged."""
OUTCOME = 2 + SIGNALS * SEGMENTS
"""Numbers of an outcome."""
