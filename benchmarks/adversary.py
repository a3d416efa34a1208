"""A trained adversary against cross-entropy: who finds the likelier failure; see RESULTS.md.

    python benchmarks/adversary.py [--simulations 4000] [--seeds 5]

The disturbance is one standard normal number for each of 20 periods. The adversary is a policy that
sees the state and chooses it (PPO of `vj.rl`); its reward is that of adaptive stress testing: the
log-density of each disturbance, and at the end of an episode without a failure a penalty that grows
with the distance from one. Cross-entropy (`search.Likeliest`) does not see the state. Both
simulate equally often; of each the likeliest failure counts, all episodes of training included.
"""

import argparse
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import verifai_jax as vj
from envs import lane_keeping as lane
from verifai_jax.addons.rl import PPO, Continuous
from verifai_jax.systems.ode import ode
from verifai_jax.systems.ode.closed_loop import substep

PERIODS = 20
FAR = 100.0
"""Penalty of an episode without a failure: more than any failure loses in log-density."""
ALGORITHM = PPO(
    learning_rate=1e-3, discount=1.0, entropy=0.0, environments=40, horizon=PERIODS, hidden=(32, 32)
)


def gusty_lane():
    """A car whose wheels a gust turns, anew every 0.48 s; how near it came to leaving its lane."""
    control, road = lane.neural(), {"speed0": 24.0, "friction": 0.9}

    def dynamics(time, state, gust, features):
        given = {**road, "bias": 0.006 * gust}
        return lane.dynamics(time, state, control(time, state, given), given)

    def margin(state):
        return lane.LANE_WIDTH / 2 - lane.CAR_WIDTH / 2 - jnp.abs(state.offset)

    loop = ode(dynamics, lambda features, key: lane.initial(road), dt=0.04,
               duration=PERIODS * 0.48)  # fmt: skip
    return loop, margin, 12


def crossing():
    """A pedestrian who walks unsteadily, anew every 0.2 s, and a car that brakes."""

    def dynamics(time, state, step, features):
        ahead = 22.0 - state["x"]
        # The car stops for somebody who will be in its lane when it arrives.
        arrives = ahead / jnp.maximum(state["speed"], 0.5)
        there = state["y"] + 1.2 * arrives
        brakes = (jnp.abs(there) < 2.6) & (ahead > 0)
        slowing = jnp.where(brakes & (state["speed"] > 0), -6.0, 0.0)
        return {"x": state["speed"], "speed": slowing, "y": 1.2 + 0.5 * step}

    def margin(state):
        return jnp.maximum(jnp.abs(22.0 - state["x"]) - 2.3, jnp.abs(state["y"]) - 1.2)

    loop = ode(dynamics, lambda features, key: {"x": 0.0, "speed": 9.0, "y": -3.4}, dt=0.02,
               duration=PERIODS * 0.2)  # fmt: skip
    return loop, margin, 10


@dataclass(frozen=True, eq=False)
class Game:
    """The disturbance as the action of a task, with the reward of adaptive stress testing."""

    loop: Any
    margin: Any
    every: int
    time_limit: int = PERIODS
    action: Any = Continuous(-4.0, 4.0)  # noqa: RUF009

    def reset(self, key):
        """Start as the loop does."""
        return self.loop.initial({}, key), jnp.inf, 0, jnp.zeros(()), jnp.array(False)

    def step(self, key, state, action):
        """Disturb for one period."""
        plant, nearest, period, density, _ = state
        trace, after = self.played(plant, action[0], period)
        before, nearest = nearest, jnp.minimum(nearest, trace)
        density = density - action[0] ** 2 / 2
        last, failed = period + 1 == PERIODS, nearest < 0
        # Of the distance as it falls, which sums up to that at the end.
        nearer = jnp.where(period > 0, before - jnp.maximum(nearest, 0.0), 0.0)
        reward = -(action[0] ** 2) / 2 + FAR * (nearer - jnp.where(last & ~failed, 1.0, 0.0))
        return (after, nearest, period + 1, density, failed), reward / FAR, failed

    def played(self, plant, disturbance, period):
        """Return the smallest margin of a period, and the state after it."""

        def small(carry, _):
            now, time = carry
            after = substep(self.loop, {}, disturbance, time, now, self.loop.dt)
            return (after, time + self.loop.dt), self.margin(after)

        start = plant, period * self.loop.dt * self.every
        (after, _), margins = jax.lax.scan(small, start, None, self.every)
        return margins.min(), after

    def observe(self, state):
        """Return the state of the plant and the time."""
        numbers = [jnp.ravel(leaf) for leaf in jax.tree.leaves(state[0])]
        return jnp.concatenate([*numbers, jnp.array([state[2] / PERIODS])])

    def simulate(self, features, key):
        """Play all periods with given disturbances: the system of a problem."""

        def one(carry, disturbance):
            (plant, period), now = carry, disturbance
            nearest, after = self.played(plant, now, period)
            return (after, period + 1), nearest

        start = self.loop.initial({}, key), 0
        given = jnp.stack([features[f"w{k}"] for k in range(PERIODS)])
        return vj.Trace({"margin": jax.lax.scan(one, start, given)[1]}, dt=1.0)


def by_adversary(game, simulations, seed):
    """Return the greatest log-density of a failure among all episodes of a training."""
    updates = simulations // ALGORITHM.environments

    def update(state, _):
        # What an episode came to, just before it is reset, is in none of the results of PPO: the
        # policy plays as many episodes of its own, which count as simulations, as it trains on.
        state, _ = ALGORITHM.step(game, state)
        return state, best_of(state)

    def best_of(state):
        policy = ALGORITHM.policy(game, state)

        def episode(key):
            def act(carry, key):
                noise = jax.random.normal(key, (1,)) * jnp.exp(state.weights.log_std)
                action = jnp.clip(4 * (policy(game.observe(carry)) + noise), -4, 4)
                after, _, failed = game.step(key, carry, action)
                return jax.tree.map(lambda a, b: jnp.where(carry[4], a, b), carry, after), failed

            keys = jax.random.split(key, PERIODS)
            end, _ = jax.lax.scan(act, game.reset(key), keys)
            return jnp.where(end[4], end[3], -jnp.inf)

        return jax.vmap(episode)(jax.random.split(state.key, ALGORITHM.environments)).max()

    state = ALGORITHM.init(game, jax.random.key(seed), updates)
    _, best = jax.jit(lambda s: jax.lax.scan(update, s, None, updates))(state)
    return float(best.max()), np.maximum.accumulate(np.asarray(best))


def by_cross_entropy(game, simulations, seed):
    """Return the greatest log-density of a failure that cross-entropy found."""
    space = {f"w{k}": vj.Normal(0.0, 1.0) for k in range(PERIODS)}
    problem = vj.Problem("game", space, game.simulate, "always margin >= 0")
    run = vj.falsify(problem, vj.search.Likeliest(vj.search.CrossEntropy()), simulations, seed=seed,
                     confirm=False, progress=False)  # fmt: skip
    failing = run.table.counterexamples
    points = failing[list(space)].to_numpy()
    return -np.min(np.sum(points**2, axis=1)) / 2 if len(points) else -np.inf


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--simulations", type=int, default=4000)
    parser.add_argument("--seeds", type=int, default=5)
    args = parser.parse_args()
    for name, made in (("lane keeping with gusts", gusty_lane()), ("crossing", crossing())):
        game = Game(*made)
        for seed in range(args.seeds):
            trained, course = by_adversary(game, args.simulations, seed)
            searched = by_cross_entropy(game, args.simulations, seed)
            tenth = course[len(course) // 10]
            print(
                f"{name}, seed {seed}: adversary {trained:.2f} (after a tenth {tenth:.2f}), "
                f"cross-entropy {searched:.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
