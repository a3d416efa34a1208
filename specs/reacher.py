"""What a controller of the reacher must keep, for which targets and loads.

verifai-jax falsify specs/reacher.py:reach
"""

import verifai_jax as vj
from envs.reacher import NOMINAL, TOLERANCE, Controller, neural, reacher
from verifai_jax.addons.rl import Policy

space = vj.FeatureSpace(
    {
        "target_angle": vj.Box(-3.1, 3.1),
        "target_radius": vj.Box(0.2, 0.6),
        "elbow0": vj.Box(-2.0, 2.0),
        "load": vj.Box(0.05, 0.4),
        "strength": vj.Box(0.8, 1.2),
    }
)


def _reach(controller: Controller | None = None) -> vj.Problem:
    return vj.Problem(
        "reach",
        space,
        reacher(*space.domains, controller=controller, duration=2.4),
        f"eventually[0, 2] always[0, 0.4] distance <= {TOLERANCE}",
        nominal={name: NOMINAL[name] for name in space.domains},
        description="be within 5 cm of the target after 2 s at most, and stay for 0.4 s",
    )


reach = _reach()


def reach_with(policy: Policy) -> vj.Problem:
    """Return `reach` for a policy; JAX may trace its weights."""
    return _reach(neural(policy))
