"""A trace of a road as OpenSCENARIO: what is read again is what was simulated."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

import verifai_jax as vj
from envs.road import CAR, PERSON, VAN, Picture
from envs.road.bodies import Pose
from envs.road.openscenario import write_openscenario

TIME = np.arange(5) * 0.25
TRACE = vj.Trace(
    {
        "ego_x": 10 * TIME, "ego_y": 0 * TIME, "ego_heading": 0.1 * TIME,
        "person_x": 20 + 0 * TIME, "person_y": TIME - 3, "person_heading": 0 * TIME + np.pi / 2,
        "gap": 20 - 10 * TIME,
    },
    dt=0.25, valid=4,
)  # fmt: skip
PICTURE = Picture(
    {"ego": CAR, "person": PERSON}, standing=lambda features: [(Pose(features["van"], 3, 0), VAN)]
)


def test_poses_are_those_of_the_trace(tmp_path):
    path = write_openscenario(TRACE, PICTURE, tmp_path / "a.xosc", {"van": 15.0})
    again = write_openscenario(TRACE, PICTURE, tmp_path / "b.xosc", {"van": 15.0})
    assert path.read_bytes() == again.read_bytes()
    root = ElementTree.parse(path).getroot()
    kinds = {each.get("name"): each[0].tag for each in root.iter("ScenarioObject")}
    assert kinds == {"ego": "Vehicle", "person": "Pedestrian", "standing_1": "Vehicle"}
    ego = next(each for each in root.iter("ManeuverGroup") if each.get("name") == "ego")
    vertices = [
        [float(vertex.get("time"))] + [float(vertex[0][0].get(part)) for part in "xyh"]
        for vertex in ego.iter("Vertex")
    ]
    # What does not count is not there.
    np.testing.assert_allclose(vertices, np.stack([TIME, 10 * TIME, 0 * TIME, 0.1 * TIME], 1)[:4])
    starts = {each.get("entityRef"): each for each in root.iter("Private")}
    van = next(starts["standing_1"].iter("WorldPosition"))
    assert (van.get("x"), van.get("y")) == ("15.000000", "3.000000")
    end = root.find("Storyboard/StopTrigger").iter("SimulationTimeCondition")
    assert float(next(end).get("value")) == pytest.approx(0.75)
    box = root.find(".//Vehicle[@name='ego']/BoundingBox/Dimensions")
    assert (box.get("length"), box.get("width")) == ("4.7", "1.85")
