"""The library of requirements: each is read, is sound, has a source, and units for its signals."""

import re

import pytest

from verifai_jax import mtl
from verifai_jax.core.messages.errors import UnknownNameError

LIBRARY = mtl.templates()
DOMAINS = {"patterns", "control", "driving", "flight", "robots", "medical", "power", "process"}


def test_there_are_sixty_of_all_domains():
    assert len(LIBRARY) >= 60
    assert {each.domain for each in LIBRARY} == DOMAINS
    assert len({each.id for each in LIBRARY}) == len(LIBRARY)
    assert all(each.text and each.source for each in LIBRARY)


@pytest.mark.parametrize("template", LIBRARY, ids=lambda each: each.id)
def test_each_is_sound_and_names_all_its_signals(template):
    formula = template.formula
    assert set(formula.signals()) == set(template.signals)
    assert mtl.parse(str(formula)) == formula
    unused = {name for name in template.constants if name not in template.expression}
    assert not unused
    found = mtl.lint([template.requirement()], units=template.signals)
    # A guard in another unit is part of some; nothing else is suspicious.
    assert {finding.kind for finding in found} <= {"units"}, str(found)


def test_words_and_domains_find_templates():
    assert [each.id for each in mtl.templates("glucose pancreas")] == ["no-insulin-when-low"]
    assert {each.domain for each in mtl.templates(domain="power")} == {"power"}
    assert mtl.templates("drones country")[0].id == "small-drone-altitude"
    assert [each.id for each in mtl.templates("settling")] == ["settling-time"]
    assert mtl.templates("no such words") == ()
    with pytest.raises(UnknownNameError, match="unknown domain 'fligth'; did you mean 'flight'"):
        mtl.templates(domain="fligth")


def test_a_template_becomes_a_requirement_with_other_constants():
    (gap,) = mtl.templates("time-gap")
    requirement = gap.requirement(time_gap=1.5)
    assert str(requirement.formula) == "always (v > 1 -> gap - 1.5 * v >= 0)"
    assert (requirement.id, requirement.unit) == ("time-gap", "m")
    with pytest.raises(UnknownNameError, match="unknown constant of time-gap 'gap_time'"):
        gap.requirement(gap_time=1.0)
    assert str(gap).splitlines()[2:] == [
        "  with time_gap = 0.8, v_standstill = 1",
        "  signals gap [m], v [m/s]",
        "  source  look up the standard of adaptive cruise control; its numbers are examples",
    ]


def test_no_template_quotes_a_number_of_a_standard():
    # Nobody has read them for the library: a paper or a benchmark has a year at most.
    for each in LIBRARY:
        cited = each.source.startswith(("after ", "look up ")) or "ARCH-COMP" in each.source
        assert cited, each.source
        assert each.example or "ARCH-COMP" in each.source or not re.search(r"\d", each.expression)
