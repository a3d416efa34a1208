"""Failure probabilities that are known: robustness as a function of points of the unit cube."""

import numpy as np
from scipy.special import ndtr, ndtri
from scipy.stats import chi2, norm

from verifai_jax.addons.estimation.normal_space import LimitState


def closed_form(robustness, dim, budget, **options):
    """A limit_state of a closed form; nothing is simulated."""

    def evaluate(u):
        rho = robustness(u)
        return rho, rho < 0, np.isfinite(rho)

    return LimitState(evaluate, dim, budget, batch=100_000, **options)


def normal(u):
    u = np.clip(u, 1e-300, None)
    return np.where(u < 0.5, ndtri(u), -ndtri(np.maximum(1 - u, 1e-17)))


def half_space(dim, p):
    """`a z > b` with unit `a`; p = Phi(-b)."""
    a = np.random.default_rng(dim).standard_normal(dim)
    a /= np.linalg.norm(a)
    return lambda u: norm.isf(p) - normal(u) @ a


def sphere(dim, p):
    """Outside of a ball; p is the upper tail of chi-squared."""
    return lambda u: np.sqrt(chi2.isf(p, dim)) - np.linalg.norm(normal(u), axis=1)


def two_modes(dim, p, share):
    """Two opposite half-spaces, the first with this share of p."""
    a = np.zeros(dim)
    a[0] = 1.0
    near, far = norm.isf(p * share), norm.isf(p * (1 - share))
    return lambda u: np.minimum(near - normal(u) @ a, far + normal(u) @ a)


def with_gradient(robustness, gradient, dim, budget):
    """A limit state of a closed form in normal space, with its gradient there."""

    def evaluate(u):
        rho = robustness(normal(u))
        return rho, rho < 0, np.isfinite(rho)

    def differentiate(u):
        z = normal(u)
        return *evaluate(u), gradient(z) / norm.pdf(z)

    return LimitState(evaluate, dim, budget, batch=10_000, gradient=differentiate)


def islands(centres, radii, speeds):
    """Robustness and gradient of balls that fail, to which it falls at different speeds."""

    def both(z):
        away = z[:, None] - centres
        far = np.linalg.norm(away, axis=2)
        margins = (far - radii) * speeds
        own, rows = margins.argmin(axis=1), np.arange(len(z))
        slopes = away[rows, own] / far[rows, own][:, None] * speeds[own][:, None]
        return margins[rows, own], slopes

    return lambda z: both(z)[0], lambda z: both(z)[1]


class Cells:
    """Failures that need some of the features near certain values, and any values of the others.

    - `centres`, `reach`: middle and half width `[k, d]` of each cell in the unit cube.
    - `masses`: their probabilities `[k]`.
    """

    def __init__(self, dim, count, deciding, seed=0):
        rng = np.random.default_rng(seed)
        self.centres, self.reach = np.full((count, dim), 0.5), np.ones((count, dim))
        self.masses = 10 ** rng.uniform(-5, -4, count)
        for centre, reach, mass in zip(self.centres, self.reach, self.masses, strict=True):
            own = rng.choice(dim, deciding, replace=False)
            side = mass ** (1 / deciding)
            centre[own], reach[own] = rng.uniform(side, 1 - side, deciding), side / 2
        self.speeds = np.exp(rng.uniform(-0.7, 0.7, count))

    def margins(self, u):
        """The margin `[n, k]` of each cell, in units of the cube."""
        return np.max(np.abs(u[:, None] - self.centres) - self.reach, axis=2)

    def of(self, z):
        """The cell `[n]` that points of normal space are in or nearest to."""
        return self.margins(ndtr(z)).argmin(axis=1)

    def evaluate(self, u):
        rho = np.min(self.margins(u) * self.speeds, axis=1)
        return rho, rho < 0, np.isfinite(rho)

    def differentiate(self, u):
        rows, own = np.arange(len(u)), np.argmin(self.margins(u) * self.speeds, axis=1)
        away = u - self.centres[own]
        worst = np.argmax(np.abs(away) - self.reach[own], axis=1)
        slope = np.zeros_like(u)
        slope[rows, worst] = np.sign(away[rows, worst]) * self.speeds[own]
        return *self.evaluate(u), slope

    def limit_state(self, budget, gradient=True):
        slope = self.differentiate if gradient else None
        dim = self.centres.shape[1]
        return LimitState(self.evaluate, dim, budget, batch=100_000, gradient=slope)


CASES = {
    "half-space": half_space,
    "sphere": sphere,
    "two modes": lambda dim, p: two_modes(dim, p, 0.5),
    "uneven modes": lambda dim, p: two_modes(dim, p, 0.15),
}
