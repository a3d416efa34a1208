"""A driver-assistance supervisor with a fault that needs three events in order: a black box.

The supervisor keeps a distance to the car ahead. When the camera is lost it asks the driver to take
over, and for most of a second it does not expect the driver yet. A driver who takes over just then
is never acknowledged, and a car that cuts in right afterwards is not taken for the new target:
there is no braking for two and a half seconds. Each of the events alone, and any two of them, are
harmless.

`mode` is the supervisor's own state, as its log has it: what a grey box shows of itself. The
formula speaks of the gap alone, which says nothing of how near the fault is.
"""

import numpy as np

import verifai_jax as vj

DT = 0.25
"""Sampling period in seconds."""
STEPS = 129
FREE = 60.0
"""Gap in metres where there is no car ahead."""
PENDING = 0.8
"""Seconds for which the request to take over is pending."""
CONFUSED = 2.5
"""Seconds without braking after the fault."""
FOLLOWING, DEGRADED, UNACKNOWLEDGED, CONFUSION, DRIVER = range(5)
"""Modes of the supervisor."""

ANY_TIME = vj.Box(0.3, 4)
COMMON = {
    "camera_lost": {"wait": ANY_TIME},
    "camera_back": {"wait": ANY_TIME, "after": "camera_lost"},
    "take_over": {"wait": ANY_TIME},
    "rain": {"wait": ANY_TIME, "level": vj.Box(0, 1)},
    "curve": {"wait": ANY_TIME},
}

TRAFFIC = vj.events.Automaton(
    start="free",
    events={
        ("free", "cut_in"): {"to": "following", "wait": ANY_TIME, "distance": vj.Box(4, 40)},
        ("following", "lane_change"): {"to": "free", "wait": ANY_TIME},
        **{
            (state, name): event
            for state in ("free", "following")
            for name, event in COMMON.items()
        },
    },
    max_events=8,
)


def supervise(features):
    """Drive for 32 s while the events happen; the gap in metres and the supervisor's mode."""
    pending = features["events"].listed()
    gap, closing, braking = FREE, 0.0, 6.0
    mode, since, target = FOLLOWING, 0.0, False
    gaps, modes = np.empty(STEPS), np.empty(STEPS)
    for step in range(STEPS):
        time = step * DT
        while pending and pending[0]["time"] <= time:
            event = pending.pop(0)
            kind, at = event["kind"], event["time"]
            if kind == "camera_lost":
                mode, since = DEGRADED, at
            elif kind == "camera_back":
                mode, since = FOLLOWING, at
            elif kind == "take_over":
                early = mode == DEGRADED and at - since < PENDING
                mode, since = (UNACKNOWLEDGED if early else DRIVER), at
            elif kind == "cut_in":
                if mode == UNACKNOWLEDGED and at - since < PENDING:
                    mode, since = CONFUSION, at
                gap, closing, target = event["distance"], 5.0, True
            elif kind == "lane_change":
                gap, closing, target = FREE, 0.0, False
            elif kind == "rain":
                braking = 6.0 - 1.5 * event["level"]
        if mode in (UNACKNOWLEDGED, DRIVER, CONFUSION):
            lasting = {UNACKNOWLEDGED: PENDING, DRIVER: 2.0, CONFUSION: CONFUSED}[mode]
            if time - since >= lasting:
                mode = FOLLOWING
        if target:
            if mode != CONFUSION:
                closing = max(closing - braking * DT, -2.0 if gap < FREE else 0.0)
            gap = min(gap - closing * DT, FREE)
        gaps[step], modes[step] = gap, mode
    return vj.Trace({"gap": gaps, "mode": modes}, dt=DT)


MODES = {"mode": (-0.5, 4.5, 5)}
"""Cells of behaviour: one for each mode."""

handover = vj.Problem(
    "handover",
    space={"events": TRAFFIC},
    system=vj.blackbox(supervise),
    spec="always gap > 0",
    nominal={"events": []},
    behaviour=vj.Behaviour(MODES),
    description="a supervisor with a fault that needs three events in order",
)
