"""The number of clauses of a requirement that have values of their own (`mtl.clauses`)."""

CLAUSES = 4
"""Clauses of a goal that have values of their own; those beyond are joined in the last one."""

ABSENT = -1e9
"""The value of a clause that a goal does not have: broken, whatever happens."""
