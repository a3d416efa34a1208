"""Simulated annealing as parallel tempering: chains from cold to hot that exchange their points.

Each chain is a Metropolis walk over the cube that has, at temperature T, the density exp(-max(rho,
0) / T) (Kirkpatrick, Gelatt, Vecchi, Optimization by simulated annealing, Science 220, 1983). Pairs
of chains exchange their points with the probability that keeps these densities invariant (replica
exchange: Swendsen, Wang, 1986; Geyer, Markov chain Monte Carlo maximum likelihood, 1991). So
discoveries of hot chains move to the cold ones, without a cooling schedule of fixed length. The
hottest chains draw from the prior.

Proposals are symmetric: Gaussian steps, some in all and some in a few coordinates, with a scale
that follows the acceptance rate of each temperature and a random factor, and steps along the
difference of two other chains (differential evolution Markov chain: ter Braak, 2006), which know
the scale and direction of valleys. All failures have the same energy: cold chains wander about the
failure regions instead of resting at their deepest points.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, UInt32

from verifai_jax.addons.searches.moves import all_or_some, has_fine_cells
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Asked, Observations, Search, check_options
from verifai_jax.search.best_points import keep_best
from verifai_jax.search.draws import draw_columns, draw_uniform, standard_normal

# The shares and scales below were chosen by hand; no comparison with other values is recorded. With
# them the search is held to 2.5 times fewer simulations than uniform sampling (test_quality.py).
RESAMPLED = 0.15  # share of the proposals that draw the cell of a coordinate from the prior
NEIGHBOURING = 0.2  # share of the proposals that move to a neighbouring cell
ALONG_OTHERS = 0.7  # share of the proposals along differences of other chains
ACCEPTED = 0.3
"""Acceptance rate that the scales of the steps aim at: between 0.44 and 0.23, the best rates of a
random walk in one and in many dimensions (Gelman, Roberts, Gilks, Efficient Metropolis jumping
rules, Bayesian Statistics 5, 1996)."""
ADAPTATION = 0.3  # change of the logarithm of the scale by one acceptance
COPIES = 4  # chains that begin at one point
MIN_SCALE = 0.01  # smallest scale of the steps, in unit coordinates
MAX_SCALE = 0.5  # largest scale of the steps, in unit coordinates


class AnnealingState(NamedTuple):
    key: Key[Array, ""]
    asks: UInt32[Array, ""]
    tells: UInt32[Array, ""]
    u: Float[Array, "chains d"]  # coldest first
    energy: Float[Array, " chains"]  # infinite where a chain has yet to start
    rests: Int[Array, " chains"]  # how long a chain has been at its point
    step: Float[Array, " chains"]  # scale of the steps at this temperature
    spread: Float[Array, ""]  # of the energy over the prior; 0 until it is known


@dataclass(frozen=True)
class Annealing(Search[AnnealingState]):
    """Parallel tempering; each row of the batch is a chain at its own temperature.

    **Arguments:**
    - `chains`: minimum number of chains; if there are more than rows in a batch, they take turns.
    - `hottest`, `coldest`: the extreme temperatures, geometric in between, in units of the spread
      of the robustness at the start (from the best to the median).
    - `exploration`: share of chains that always draw from the prior; at least one chain.
    - `patience`: number of consecutive proposals a chain may refuse before it restarts elsewhere.
    **Raises:** `ValueError` for values out of range, or `coldest` above `hottest`.
    """

    chains: int = 8
    hottest: float = 0.3
    coldest: float = 0.01
    exploration: float = 0.1
    patience: int = 12

    def __post_init__(self) -> None:
        check_options(self, {"chains": 2, "patience": 1}, ["exploration"], ["hottest", "coldest"])
        if self.coldest > self.hottest:
            raise ValueError(
                "coldest must not be above hottest; got "
                f"coldest={self.coldest!r}, hottest={self.hottest!r}"
            )

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> AnnealingState:
        chains = max(self.chains, batch)
        return AnnealingState(
            key=key,
            asks=jnp.uint32(0),
            tells=jnp.uint32(0),
            u=jnp.full((chains, cube.dim), 0.5, jnp.float32),
            energy=jnp.full(chains, jnp.inf, jnp.float32),
            rests=jnp.zeros(chains, jnp.int32),
            step=jnp.full(chains, 0.3, jnp.float32),
            spread=jnp.float32(0),
        )

    def ask(self, state: AnnealingState, cube: Cube, batch: int) -> Asked[AnnealingState]:
        key = jax.random.fold_in(state.key, state.asks)
        d, k, chains = cube.dim, len(cube.discrete), len(state.energy)
        row, prior, noise, move, cell, direction = draw_columns(key, batch, 6, d, d, d, k, k)
        turn = self._turn(state, batch)
        own = state.u[turn]
        # One coordinate moves for certain, others all together or a few at a time.
        certain = jnp.arange(d) == (row[:, :1] * d).astype(jnp.int32)
        moved = certain | all_or_some(row[:, 1:2], move)
        scale = state.step[turn][:, None] * 1.5 * 0.03 ** row[:, 2:3]
        step = scale * standard_normal(noise)
        one, other = (row[:, 3:5] * chains).astype(jnp.int32).T
        along = (0.3 + 0.7 * row[:, 2:3]) * (state.u[one] - state.u[other]) + 0.1 * step
        step = jnp.where(moved, jnp.where(row[:, 5:] < ALONG_OTHERS, along, step), 0.0)
        index = np.flatnonzero(~has_fine_cells(cube))
        few = cube.discrete[index]
        # Of a cell, the neighbour or any; of a choice, any.
        width = np.array([cube.ordered[i] / cube.levels[i] for i in few], np.float32)
        either = np.where(width > 0, RESAMPLED + NEIGHBOURING, RESAMPLED)
        drawn = cell[:, index] * jnp.where(certain[:, few], either, 1.0)
        sideways = jnp.where(direction[:, index] < 0.5, width, -width)
        step = step.at[:, few].set(jnp.where((drawn > RESAMPLED) & (drawn < either), sideways, 0.0))
        u = reflect(own + step)
        u = u.at[:, few].set(jnp.where(drawn < RESAMPLED, prior[:, few], u[:, few]))
        anywhere = jnp.isinf(state.energy[turn]) | (self._coldness(chains) == 0)[turn]
        return jnp.where(anywhere[:, None], prior, u), state._replace(asks=state.asks + 1)

    def tell(self, state: AnnealingState, cube: Cube, observations: Observations) -> AnnealingState:
        batch, chains = len(observations.rho), len(state.energy)
        turn = self._turn(state, batch)
        usable = observations.usable
        new = observations.score
        before = state.energy[turn]
        spread = self._spread(state, turn, new)
        coldness = self._coldness(chains) / jnp.where(spread > 0, spread, 1.0)
        sweeps = len(partners_of(chains))
        key = jax.random.fold_in(jax.random.fold_in(state.key, state.tells), 1)
        chance = jnp.log(draw_uniform(key, (batch + sweeps * chains,)))
        rise = jnp.where(jnp.isinf(before), 0.0, coldness[turn] * (new - before))
        accepted = usable & (jnp.isinf(before) | (coldness[turn] == 0) | (chance[:batch] < -rise))
        rests = jnp.where(accepted, 0, state.rests[turn] + usable)
        # The point that a chain is at is given up after long, the next one is from the prior.
        energy = jnp.where(accepted, new, jnp.where(rests >= self.patience, jnp.inf, before))
        rate = jnp.where(usable, ADAPTATION * (accepted - ACCEPTED), 0.0)
        step = state.step[turn] * jnp.exp(rate)
        state = state._replace(
            tells=state.tells + 1,
            u=state.u.at[turn].set(jnp.where(accepted[:, None], observations.u, state.u[turn])),
            energy=state.energy.at[turn].set(energy),
            rests=state.rests.at[turn].set(rests.astype(jnp.int32)),
            step=state.step.at[turn].set(jnp.clip(step, MIN_SCALE, MAX_SCALE)),
            spread=spread,
        )
        state = self._start_at_best(state, batch)
        index = exchange(state.energy, coldness, chance[batch:].reshape(-1, chains))
        return state._replace(
            u=state.u[index], energy=state.energy[index], rests=state.rests[index]
        )

    def warm_start(
        self, state: AnnealingState, cube: Cube, observations: Observations
    ) -> AnnealingState:
        """Set the chains to the best points, the coldest chain to the best one."""
        new = observations.score
        u, energy = keep_best(observations.u, new, state.u, state.energy)
        spread = jnp.where(state.spread == 0, best_to_median(new), state.spread)
        return state._replace(u=u, energy=energy, spread=spread)

    def _start_at_best(self, state: AnnealingState, batch: int) -> AnnealingState:
        """Move all chains to the best quarter of the first round's points, after that round."""
        chains = len(state.energy)
        if chains > batch:
            return state
        index = jnp.argsort(state.energy)[np.arange(chains) // COPIES]
        index = jnp.where(state.tells == 1, index, jnp.arange(chains))
        return state._replace(u=state.u[index], energy=state.energy[index])

    def _turn(self, state: AnnealingState, batch: int) -> Int[Array, " batch"]:
        """Return the chains that the rows of the next `tell` belong to."""
        chains = len(state.energy)
        if chains == batch:
            return jnp.arange(batch, dtype=jnp.int32)
        number = (state.tells % np.uint32(chains)) * np.uint32(batch)
        turn = (number + jnp.arange(batch, dtype=jnp.uint32)) % np.uint32(chains)
        return turn.astype(jnp.int32)

    def _coldness(self, chains: int) -> Float[Array, " chains"]:
        """Return inverse temperatures in units of the inverse spread, zero for the prior."""
        warm = chains - int(np.ceil(self.exploration * chains))
        share = np.arange(chains) / max(warm - 1, 1)
        cold = self.coldest * (self.hottest / self.coldest) ** np.minimum(share, 1)
        return jnp.asarray(np.where(np.arange(chains) < warm, 1 / cold, 0.0), jnp.float32)

    def _spread(
        self, state: AnnealingState, turn: Int[Array, " n"], new: Float[Array, " n"]
    ) -> Float[Array, ""]:
        """Return the spread of the energy where the chains start; it stays unless it is zero."""
        energy = state.energy
        met = jnp.where(jnp.isinf(energy), energy.at[turn].set(new), energy)
        first = jnp.any(jnp.isinf(energy)) & (state.tells * len(turn) < len(energy))
        return jnp.where(first | (state.spread == 0), best_to_median(met), state.spread)


def best_to_median(energy: Float[Array, " n"]) -> Float[Array, ""]:
    """Return a robust spread of the finite entries, which a few large ones do not affect."""
    known = jnp.sum(jnp.isfinite(energy))
    ranked = jnp.sort(energy)
    return jnp.where(known > 0, ranked[jnp.maximum(known - 1, 0) // 2] - ranked[0], 0.0)


def reflect(u: Float[Array, "n d"]) -> Float[Array, "n d"]:
    """Reflect points into the cube, back and forth between its sides."""
    folded = jnp.abs(u - 2 * jnp.round(u / 2))
    return jnp.clip(folded, 0.0, 1.0)


def partners_of(chains: int) -> Int[np.ndarray, "matchings chains"]:
    """Return partners for exchanges; distances halve, so a point can quickly reach any chain."""
    index = np.arange(chains, dtype=np.int32)
    matchings = []
    for distance in (1 << i for i in reversed(range((chains - 1).bit_length()))):
        for first in (0, distance):
            left = (index - first) // distance % 2 == 0
            partner = np.where(left, index + distance, index - distance)
            matchings.append(np.where((partner >= 0) & (partner < chains), partner, index))
    return np.stack(matchings)


def exchange(
    energy: Float[Array, " chains"], coldness: Float[Array, " chains"],
    chance: Float[Array, "matchings chains"],
) -> Int[Array, " chains"]:  # fmt: skip
    """Return for each chain the chain whose point it takes; hot ones get the remaining points."""
    index = jnp.arange(len(energy), dtype=jnp.int32)

    def exchange(
        carry: tuple[Array, Array], inputs: tuple[Array, Array]
    ) -> tuple[tuple[Array, Array], None]:
        energy, source = carry
        partner, chance = inputs
        gain = (coldness - coldness[partner]) * (energy - energy[partner])
        # One chance for both, that of the colder.
        taken = jnp.where(chance[jnp.minimum(partner, index)] < gain, partner, index)
        return (energy[taken], source[taken]), None

    start = jnp.minimum(energy, np.float32(1e30)), index
    (_, source), _ = jax.lax.scan(exchange, start, (jnp.asarray(partners_of(len(energy))), chance))
    return source
