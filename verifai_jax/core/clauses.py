"""Clauses of a requirement: how many have values of their own, and the value of one that is absent.

`mtl.clauses` makes them, and searches learn of them.
"""

CLAUSES = 4
"""Clauses of a goal that have values of their own; those beyond are joined in the last one."""

ABSENT = -1e9
"""The value of a clause that a goal does not have: broken, whatever happens."""
