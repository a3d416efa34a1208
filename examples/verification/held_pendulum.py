"""A pendulum with a sampled controller, in whatever arithmetic `m` has sines and tangents of.

`held_pendulum_problem.py` gives it to verifai_jax, and `check_plant.py` to mpmath's intervals.
"""

FEATURES = {"angle": (0.2, 0.4), "power": (1.0, 1.2)}
SECONDS, PERIOD = 0.5, 0.1
HIGHEST = 0.42


def start(features):
    """Return the angle and the speed at first."""
    angle, power = features
    return angle, 0.0 * power


def control(state, m):
    """Return what the controller decides at each period, which is held until the next one."""
    angle, speed = state
    return -m.tanh(3.0 * angle + 1.5 * speed)


def rates(state, held, features, m):
    """Return the derivatives of the angle and of the speed."""
    angle, speed = state
    return speed, 0.8 * m.sin(angle) + features[1] * held


def margin(state):
    """Return what must never be below zero."""
    return HIGHEST - state[0]
