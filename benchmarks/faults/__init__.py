"""Fuzzers: hostile and damaged input, made from a seed, and what must hold with each.

    python benchmarks/soak.py formulas folders messages kills memory --seconds 3600 --seed 1

A fuzzer is a function `case(number) -> outcome`: the same number gives the same case, the outcome
is a word that is counted, and what must not be raises `Broken`.
"""
