"""Failure probabilities that are known: robustness as a function of points of the unit cube."""

import numpy as np
from scipy.special import ndtri
from scipy.stats import chi2, norm

from verifai_jax.estimation.normal_space import LimitState


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


CASES = {
    "half-space": half_space,
    "sphere": sphere,
    "two modes": lambda dim, p: two_modes(dim, p, 0.5),
    "uneven modes": lambda dim, p: two_modes(dim, p, 0.15),
}
