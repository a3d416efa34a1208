"""Operational design domains: files, features, coverage against brute force."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import verifai_jax as vj

ODD = """
TAXONOMY:
  scenery:
    road_type: [motorway, street, lane]
    lanes: integer count
  environment:
    rain: [none, light, heavy]
    lit: boolean
  dynamic:
    ego_speed: float velocity
    gap: float length
ODD:
  town:
    TITLE: In town
    INCLUDE_AND:
      road_type: [street, lane]
      ego_speed: "[0 .. 54] km/h"
      gap: "[5 .. 50] m"
      scenery.lanes: "[1 .. 4]"
      environment.rain: [none, light, heavy]
      OR:
        rain: [none, light]
        ego_speed: "<= 36 km/h"
    EXCLUDE_AND:
      lanes: ">= 3"
      road_type: lane
"""
BINDING = """
openodd: [odd.yaml]
name: streets
features:
  speed: {attribute: dynamic.ego_speed, unit: m/s, reason: limit of the town, source: StVO 3}
  gap: {attribute: gap}
  lanes: {attribute: scenery.lanes}
  road: {attribute: road_type}
  rain: {attribute: rain, reason: as measured}
"""


@pytest.fixture
def domain(tmp_path):
    (tmp_path / "odd.yaml").write_text(ODD)
    (tmp_path / "streets.yaml").write_text(BINDING)
    return vj.read_odd(tmp_path / "streets.yaml")


def inside(row):
    """Say by hand whether a row is inside of the domain."""
    return (
        row["road"] in ("street", "lane")
        and 0 <= row["speed"] <= 15
        and 5 <= row["gap"] <= 50
        and 1 <= row["lanes"] <= 4
        and (row["rain"] != "heavy" or row["speed"] <= 10)
        and not (row["lanes"] >= 3 and row["road"] == "lane")
    )


def rows(count, seed=0):
    rng = np.random.default_rng(seed)
    return pd.DataFrame(
        {
            "speed": rng.uniform(-1, 20, count),
            "gap": rng.uniform(0, 60, count),
            "lanes": rng.integers(0, 6, count),
            "road": rng.choice(["motorway", "street", "lane"], count),
            "rain": rng.choice(["none", "light", "heavy"], count),
        }
    )


def test_what_is_inside(domain):
    some = rows(500)
    assert domain.holds(some).tolist() == [inside(row) for _, row in some.iterrows()]
    assert domain.units == {"speed": "m/s", "gap": "m", "lanes": "count"}
    assert domain.reasons == {"speed": "limit of the town, StVO 3", "rain": "as measured"}
    assert not domain.is_box
    assert "dynamic.ego_speed: 0 to 15 m/s, feature speed" in str(domain)
    assert "environment.lit: false, true, no feature" in str(domain)


@pytest.mark.thorough
def test_its_space_is_the_domain(domain):
    space = domain.space()
    assert space.domains["speed"] == vj.Box(0.0, 15.0)
    assert space.domains["lanes"] == vj.DiscreteBox(1, 4)
    assert space.domains["road"] == vj.Categorical("street", "lane")
    sampled = pd.DataFrame(space.rows(space.sample(jax.random.key(0), 200)))
    assert all(inside(row) for _, row in sampled.iterrows())
    assert {(row["road"], row["lanes"]) for _, row in sampled.iterrows()} == {
        ("street", n) for n in (1, 2, 3, 4)
    } | {("lane", n) for n in (1, 2)}


def test_coverage_is_that_of_brute_force(domain):
    some = rows(60, seed=1)
    found = domain.coverage(some, cells=5)
    kept = some[[inside(row) for _, row in some.iterrows()]]
    assert found.rows == 60
    assert found.outside == 60 - len(kept)
    cells = {
        "dynamic.ego_speed": ((kept["speed"] / 3).clip(upper=4.999)).astype(int),
        "dynamic.gap": ((kept["gap"] - 5) / 9).astype(int),
        "scenery.lanes": kept["lanes"],
        "scenery.road_type": kept["road"],
        "environment.rain": kept["rain"],
    }
    grid = pd.DataFrame(
        list(itertools.product(np.arange(0.05, 15, 0.1), range(1, 5), ["street", "lane"],
                               ["none", "light", "heavy"])),
        columns=["speed", "lanes", "road", "rain"],
    )  # fmt: skip
    grid = grid.assign(gap=10.0)
    grid = grid[[inside(row) for _, row in grid.iterrows()]]
    for name, codes in cells.items():
        assert found.table.loc[name, "occupied"] == codes.nunique()
    pair = found.pairs.loc[("scenery.road_type", "scenery.lanes")]
    assert (pair["cells"], pair["occupied"]) == (
        6,
        len(set(zip(kept["lanes"], kept["road"], strict=True))),
    )
    taken = set(zip(cells["dynamic.ego_speed"], kept["rain"], strict=True))
    exact = np.mean([
        (int(speed // 3), rain) in taken
        for speed, rain in zip(grid["speed"], grid["rain"], strict=True)
    ])  # fmt: skip
    rain = found.pairs.loc[("environment.rain", "dynamic.ego_speed")]
    assert rain["volume"] == pytest.approx(exact, abs=0.01)
    assert np.isnan(rain["mass"])
    assert found.table.loc["environment.lit", "feature"] == ""
    assert "environment.lit: never varied" in str(found)


@pytest.mark.thorough
def test_the_next_points_fill_what_is_empty(domain):
    some = rows(40, seed=2)
    found = domain.coverage(some, cells=5)
    more = found.next_points(15)
    assert domain.holds(more).all()
    assert more["new"].is_monotonic_decreasing
    after = domain.coverage(pd.concat([some, more[some.columns]], ignore_index=True), cells=5)
    gained = (after.table["occupied"] - found.table["occupied"]).sum()
    gained += (after.pairs["occupied"] - found.pairs["occupied"]).sum()
    assert gained == more["new"].sum()
    # A full table leaves nothing.
    few = domain.coverage(some, cells=2).next_points(500)
    whole = domain.coverage(pd.concat([some, few[some.columns]], ignore_index=True), cells=2)
    assert (whole.table.loc[whole.table["feature"] != "", "volume"] == 1).all()
    assert len(whole.next_points(3)) == 0


def wide():
    space = vj.FeatureSpace({"x": vj.TruncatedNormal(0, 1, -3, 3), "y": vj.Box(0.0, 2.0)})

    def system(features, key):
        return vj.Trace({"z": features["x"] * jnp.ones(2)}, dt=1.0)

    return vj.Problem("p", space, system, "always z < 9")


@pytest.mark.slow
def test_the_mass_is_that_of_the_prior():
    odd = vj.odd_of(vj.FeatureSpace({"x": vj.Box(-1.0, 1.0), "y": vj.Box(0.0, 1.0)}), "part")
    assert odd.is_box
    run = vj.falsify(wide(), "uniform", 12, progress=False)
    found = odd.coverage(run, cells=4)
    assert found.prior_inside == pytest.approx(0.6827 / 0.9973 / 2, abs=0.01)
    kept = run.table.all.query("-1 <= x <= 1 and 0 <= y <= 1")
    codes = set(np.floor((kept["x"] + 1) * 2).astype(int))
    share = {0: 0.2195, 1: 0.2805, 2: 0.2805, 3: 0.2195}
    assert found.table.loc["x", "volume"] == len(codes) / 4
    assert found.table.loc["x", "mass"] == pytest.approx(sum(share[c] for c in codes), abs=0.01)
    assert found.pairs.loc[("x", "y"), "cells"] == 16


@pytest.mark.slow
def test_a_report_says_what_is_covered(tmp_path):
    odd = vj.odd_of(vj.FeatureSpace({"x": vj.Box(-1.0, 1.0)}), "part")
    run = vj.falsify(wide(), "uniform", 12, progress=False)
    page = run.report(tmp_path / "r.html", odd=odd, studies=False, traces=0).read_text()
    assert "The operational design domain part" in page
    assert "are outside the domain, and not counted below" in page
    with pytest.raises(TypeError, match="odd= is for a report on a run; got Estimate"):
        vj.estimate(run.problem, budget=64, progress=False).report(tmp_path / "e.html", odd=odd)


def test_files_are_read_again(domain, tmp_path):
    path = domain.write(tmp_path / "again.yaml")
    again = vj.read_odd(path)
    assert again.document == domain.document
    assert again.features.keys() == {"road_type", "lanes", "rain", "lit", "ego_speed", "gap"}
    space = vj.FeatureSpace(
        {"v": vj.Box(0.0, 9.0), "n": vj.DiscreteBox(1, 3), "c": vj.Categorical("a", "b")}
    )
    written = vj.odd_of(space, "made", units={"v": "m/s"}).write(tmp_path / "made.yaml")
    assert "float velocity" in written.read_text()
    assert vj.read_odd(written).space() == space
    (tmp_path / "parts.yaml").write_text("IMPORT: again.yaml\n")
    assert vj.read_odd(tmp_path / "parts.yaml").document["ODD"] == domain.document["ODD"]


def test_labels_groups_and_units_of_the_file(tmp_path):
    (tmp_path / "odd.yaml").write_text("""
TAXONOMY:
  a: bool
  b: boolean
  depth: float length
  road: [track, {paved: [street, motorway]}]
MODULES:
  m1: {LABEL: x, INCLUDE_AND: {a: true}}
  m2: {LABELS: [x], INCLUDE_AND: {b: true}}
  m3: {LABEL: x, ACTIVE: false, INCLUDE_AND: {a: false}}
  n: {INCLUDE_AND: {x: true, depth: "[0 .. 5] fathom", road: paved}}
conversion: {length: {fathom: {m: {scale: 1.8288}}}}
""")
    odd = vj.read_odd(tmp_path / "odd.yaml")
    assert odd.roots == ("n",)
    rows = pd.DataFrame(
        [(a, b, d, road) for a in (True, False) for b in (True, False) for d in (9.1, 9.2)
         for road in ("track", "street")],
        columns=["a", "b", "depth", "road"],
    )  # fmt: skip
    expected = (rows["a"] | rows["b"]) & (rows["depth"] < 9.144) & (rows["road"] == "street")
    assert odd.holds(rows).tolist() == expected.tolist()
    assert odd.hull(odd.features["road"]) == frozenset({1, 2})


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("[0 .. 54] km/h", "0 to 54", r"ego_speed: expected .* got '0 to 54'"),
        ("[0 .. 54] km/h", "[0 .. 54] kg", "kg cannot be converted into m/s"),
        ("[street, lane]", "[street, path]", "'path' is not one of its values, motorway, street"),
        ("      gap:", "      gape:", "unknown attribute or module of module town of .* 'gape'"),
        ("TITLE", "TITEL", "unknown entry of module town of .* 'TITEL'.*TITLE"),
        ("rain: [none", "rain: !!python/name:os.system [none", "is not YAML"),
        ("ego_speed: float velocity", "ego_speed:", "ego_speed must be a list of literals, or"),
        ("ego_speed: float velocity", "ego_speed: date", "kind date has no values to compare"),
        ('lanes: ">= 3"', "town: true", "in a circle: town -> town"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, old, new, match):
    assert ODD.count(old) >= 1
    (tmp_path / "odd.yaml").write_text(ODD.replace(old, new, 1))
    with pytest.raises(ValueError, match=match):
        vj.read_odd(tmp_path / "odd.yaml")


def test_a_domain_without_bounds_has_no_space(tmp_path):
    (tmp_path / "odd.yaml").write_text("TAXONOMY: {a: {b: float}}")
    with pytest.raises(ValueError, match=r"a.b has no range in the domain \(-inf to inf\)"):
        vj.read_odd(tmp_path / "odd.yaml").space()
    with pytest.raises(FileNotFoundError, match="no file of an operational design domain"):
        vj.read_odd(tmp_path / "none.yaml")
