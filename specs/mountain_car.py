"""What a controller of the mountain car must keep, in which valleys.

    verifai-jax falsify specs/mountain_car.py:climb
    verifai-jax falsify specs/mountain_car.py:climb_continuous --search cross_entropy
    verifai-jax falsify specs/mountain_car.py:careful
    verifai-jax sweep specs/mountain_car.py:safe_training --search grid --configurations 6

The car starts anywhere on the left of the valley's slopes, slow or fast, with an engine and a
gravity that differ from those the controller was made for. A step of the car counts as a second.
"""

import verifai_jax as vj
from envs.mountain_car import Controller, MountainCarTask, along, mountain_car, neural
from envs.mountain_car_drawing import draw
from verifai_jax.addons.rl import PPO, PQN, Continuous, Policy

NOMINAL = {"position0": -0.5, "velocity0": 0.0, "gravity": 0.0025, "velocity_bias": 0.0}
starts = {"position0": vj.Box(-1.0, 0.2), "velocity0": vj.Box(-0.03, 0.03)}

discrete = vj.FeatureSpace(
    {
        **starts,
        "power": vj.Box(0.0009, 0.0012),
        "gravity": vj.Box(0.0023, 0.0027),
        "velocity_bias": vj.Box(-0.002, 0.002),
    }
)
continuous = vj.FeatureSpace(
    {
        **starts,
        "power": vj.Box(0.0012, 0.0018),
        "gravity": vj.Box(0.0022, 0.0028),
        "velocity_bias": vj.Box(-0.005, 0.005),
    }
)


def _discrete(controller: Controller | None = None) -> vj.Problem:
    return vj.Problem(
        "climb",
        discrete,
        mountain_car(controller),
        "eventually[0, 200] position >= 0.5",
        nominal={**NOMINAL, "power": 0.001},
        description="reach the flag within 200 s, whatever the start, the engine and the gravity",
        draw=draw,
    )


def _continuous(controller: Controller | None = None) -> vj.Problem:
    return vj.Problem(
        "climb_continuous",
        continuous,
        mountain_car(controller, continuous=True, steps=300),
        "eventually[0, 300] position >= 0.45",
        nominal={**NOMINAL, "power": 0.0015},
        description="reach the flag within 300 s with a throttle that is continuous",
        draw=draw,
    )


def _careful(controller: Controller) -> vj.Problem:
    return vj.Problem(
        "careful",
        vj.FeatureSpace(
            {
                **continuous.domains,
                "position0": vj.Box(-0.9, 0.0),
                "velocity0": vj.Box(-0.02, 0.02),
            }
        ),
        mountain_car(controller, continuous=True, steps=300),
        {
            "clear": "always[0, 300] position >= -1.19",
            "slow": "always[0, 300] abs(velocity) <= 0.068",
            "climbs": "eventually[0, 300] position >= 0.45",
        },
        priority=["clear", "slow", "climbs"],
        nominal={**NOMINAL, "power": 0.0015},
        description="never hit the wall on the left, never be too fast, and reach the flag",
        draw=draw,
    )


climb = _discrete()
climb_continuous = _continuous()
careful = _careful(along(enough=0.4))


def climb_with(policy: Policy) -> vj.Problem:
    """Return the climb under a policy: `climb_continuous` or `climb`, as its actions are.

    JAX may trace its weights.
    """
    make = _continuous if isinstance(policy.action, Continuous) else _discrete
    return make(neural(policy))


def careful_with(policy: Policy) -> vj.Problem:
    """Return `careful` under a policy with either kind of action; JAX may trace its weights."""
    return _careful(neural(policy))


def trained_on(size: float) -> MountainCarTask:
    """Return the task of trainings: other starts, engines and gravities too, shaped rewards."""
    return MountainCarTask(potential=size, start_range=0.4, power_range=0.2, gravity_range=0.1)


# The paper's study: which algorithm, and how large a training set, gives a network that climbs the
# hill? The sizes are checkpoints of one training, so they cost nothing beside the largest.
safe_training = vj.Study(
    "safe_training",
    vj.FeatureSpace(
        {
            "algorithm": vj.Categorical("ppo", "pqn"),
            "potential": vj.Categorical(1.0, 10.0, 100.0),
        }
    ),
    vj.Trainer(
        trained_on(10.0),
        {
            "ppo": PPO(
                learning_rate=3e-3,
                environments=16,
                hidden=(32, 32),
                value_hidden=(32, 32),
                normalise=True,
                anneal=False,
            ),
            "pqn": PQN(hold=10.0, hidden=(32, 32), anneal=False),
        },
        steps=131_072,
        nominal=MountainCarTask(),
    ),
    climb_with,
    checkpoints=(8_192, 16_384, 32_768, 65_536),
    seeds=2,
    p=0.01,
    description="which algorithm, shaping and training-set size give a policy that climbs the hill",
)
