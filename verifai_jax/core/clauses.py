"""How many clauses of a requirement are told apart; `mtl.clauses` computes them for searches."""

CLAUSES = 4
"""Clauses of a goal that have values of their own; those beyond are joined in the last one."""
