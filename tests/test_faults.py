"""Some seconds of each fuzzer; `benchmarks/soak.py` runs them for as long as one likes."""

import logging

import pytest

from benchmarks.faults import folders, formulas, kills, messages
from benchmarks.faults.cases import tally

SECONDS = 8.0


@pytest.mark.slow
def test_texts():
    found = tally(formulas.case, 0, cases=15_000, seconds=SECONDS)
    assert not found.broken, found
    assert found.outcomes["formula"] > 100
    assert found.outcomes["refused"] > 100


@pytest.mark.slow
def test_folders():
    found = tally(folders.case, 0, cases=1500, seconds=SECONDS)
    assert not found.broken, found
    assert found.outcomes["resumed"] > 1


@pytest.mark.slow
def test_messages():
    logging.getLogger("verifai_jax.remote").setLevel(logging.CRITICAL)
    with messages.fire() as fire:
        found = tally(fire.case, 0, cases=10_000, seconds=SECONDS)
    assert not found.broken, found
    assert found.cases > 100


@pytest.mark.slow
def test_kills():
    found = tally(kills.case, 0, cases=2, seconds=SECONDS)
    assert not found.broken, found
    assert found.cases >= 1
