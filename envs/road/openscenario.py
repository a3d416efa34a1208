"""A trace of a road scene as OpenSCENARIO XML 1.2 of ASAM, for the tools that replay such files.

    replay = run.replay(run.best.name)
    write_openscenario(replay.trace, problem.draw, "worst.xosc")

Each body follows the polyline of its poses, with their times; what stands stands. There is no road
network in it: positions are of the world, in m.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from envs.road.bodies import PERSON, Body
from envs.road.drawing import Picture
from verifai_jax import Trace

HEIGHT = 1.6
"""Height in m of a body: the scene is flat, and a file must say one."""
PARTS = ("x", "y", "heading")
"""Ends of the names of a pose's signals."""
DATE = "1970-01-01T00:00:00"
"""A date must be there, and the same trace gives the same file."""


def write_openscenario(
    trace: Trace, picture: Picture, path: str | Path, features: Mapping[str, Any] | None = None
) -> Path:
    """Write what moves in a trace as an OpenSCENARIO file.

    **Arguments:**

    - `trace`: signals `name_x`, `name_y`, `name_heading` of each body.
    - `picture`: the problem's picture, which says what the bodies are.
    - `path`: the file.
    - `features`: of the simulation, for what stands.

    **Returns:** the path.
    """
    valid = trace.length if trace.valid is None else int(trace.valid)
    times = np.asarray(trace.clock(), float)[:valid]
    poses = {
        name: np.stack([np.asarray(trace[f"{name}_{part}"], float)[:valid] for part in PARTS], 1)
        for name in picture.bodies
    }
    bodies = dict(picture.bodies)
    if picture.standing is not None and features is not None:
        for number, (pose, body) in enumerate(picture.standing(features), 1):
            bodies[f"standing_{number}"] = body
            poses[f"standing_{number}"] = np.array([pose], float)
    root = Element("OpenSCENARIO")
    SubElement(root, "FileHeader", revMajor="1", revMinor="2", date=DATE, author="verifai_jax",
               description="a simulated trace")  # fmt: skip
    for empty in ("ParameterDeclarations", "CatalogLocations", "RoadNetwork"):
        SubElement(root, empty)
    entities = SubElement(root, "Entities")
    for name, body in bodies.items():
        _entity(SubElement(entities, "ScenarioObject", name=name), name, body)
    storyboard = SubElement(root, "Storyboard")
    actions = SubElement(SubElement(storyboard, "Init"), "Actions")
    for name, rows in poses.items():
        action = SubElement(SubElement(actions, "Private", entityRef=name), "PrivateAction")
        _position(SubElement(action, "TeleportAction"), rows[0])
    act = SubElement(SubElement(storyboard, "Story", name="trace"), "Act", name="trace")
    for name in picture.bodies:
        _follow(act, name, times, poses[name])
    _after(SubElement(act, "StartTrigger"), "begin", 0.0)
    _after(SubElement(storyboard, "StopTrigger"), "end", float(times[-1]))
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
    return Path(path)


def _entity(parent: Element, name: str, body: Body) -> None:
    """Write what a body is: a pedestrian or a vehicle, with its box."""
    length, width = f"{body.length:zg}", f"{body.width:zg}"
    if body == PERSON:
        about = {"mass": "75", "pedestrianCategory": "pedestrian"}
        kind = SubElement(parent, "Pedestrian", about, name=name)
    else:
        category = "car" if body.length < 8 else "truck"
        kind = SubElement(parent, "Vehicle", name=name, vehicleCategory=category)
    box = SubElement(kind, "BoundingBox")
    SubElement(box, "Center", x=f"{body.ahead:zg}", y="0", z=f"{HEIGHT / 2:zg}")
    SubElement(box, "Dimensions", width=width, length=length, height=f"{HEIGHT:zg}")
    if body != PERSON:
        SubElement(kind, "Performance", maxSpeed="70", maxAcceleration="10", maxDeceleration="10")
        axles = SubElement(kind, "Axles")
        wheel = {"maxSteering": "0.6", "wheelDiameter": "0.6", "positionZ": "0.3"}
        for word, x in (("FrontAxle", 0.6 * body.length), ("RearAxle", 0.0)):
            SubElement(axles, word, wheel, trackWidth=width, positionX=f"{x:zg}")
    SubElement(kind, "Properties")


def _follow(act: Element, name: str, times: np.ndarray, poses: np.ndarray) -> None:
    """Let a body follow its poses in their times."""
    group = SubElement(act, "ManeuverGroup", name=name, maximumExecutionCount="1")
    actors = SubElement(group, "Actors", selectTriggeringEntities="false")
    SubElement(actors, "EntityRef", entityRef=name)
    maneuver = SubElement(group, "Maneuver", name=name)
    event = SubElement(maneuver, "Event", name=name, priority="override")
    action = SubElement(SubElement(event, "Action", name=name), "PrivateAction")
    follow = SubElement(SubElement(action, "RoutingAction"), "FollowTrajectoryAction")
    reference = SubElement(follow, "TrajectoryRef")
    trajectory = SubElement(reference, "Trajectory", name=name, closed="false")
    line = SubElement(SubElement(trajectory, "Shape"), "Polyline")
    for time, pose in zip(times, poses, strict=True):
        _position(SubElement(line, "Vertex", time=f"{time:z.6f}"), pose)
    reference = SubElement(follow, "TimeReference")
    SubElement(reference, "Timing", domainAbsoluteRelative="absolute", scale="1", offset="0")
    SubElement(follow, "TrajectoryFollowingMode", followingMode="position")
    _after(SubElement(event, "StartTrigger"), name, 0.0)


def _position(parent: Element, pose: np.ndarray) -> None:
    x, y, heading = (f"{value:z.6f}" for value in pose)
    SubElement(SubElement(parent, "Position"), "WorldPosition", x=x, y=y, h=heading)


def _after(trigger: Element, name: str, time: float) -> None:
    """Trigger at a time."""
    group = SubElement(trigger, "ConditionGroup")
    condition = SubElement(group, "Condition", name=name, delay="0", conditionEdge="none")
    by_value = SubElement(condition, "ByValueCondition")
    SubElement(by_value, "SimulationTimeCondition", value=f"{time:zg}", rule="greaterOrEqual")
