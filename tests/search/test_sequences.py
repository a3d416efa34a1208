"""Uniform and Halton points against what is known of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked
from scipy import stats

from verifai_jax.core.values.cube import Cube
from verifai_jax.search import Halton, Uniform, from_json, to_json
from verifai_jax.search.halton import halton_points, primes


def exact_inverse(index, base):
    inverse, weight = 0.0, 1.0
    while index:
        weight /= base
        index, figure = divmod(index, base)
        inverse += weight * figure
    return inverse


def points(search, dim, count, seed=0):
    cube = Cube((0,) * dim)
    first = jax.jit(lambda key: search.ask(search.init(key, cube, count), cube, count)[0])
    return np.asarray(first(jax.random.key(seed)))


class TestHalton:
    def test_the_first_points(self):
        # Radical inverses of 1..8 in bases 2, 3, 5, 7, as VerifAI's Halton sampler gives them.
        np.testing.assert_allclose(
            points(Halton(), 4, 8),
            [
                [1 / 2, 1 / 3, 1 / 5, 1 / 7],
                [1 / 4, 2 / 3, 2 / 5, 2 / 7],
                [3 / 4, 1 / 9, 3 / 5, 3 / 7],
                [1 / 8, 4 / 9, 4 / 5, 4 / 7],
                [5 / 8, 7 / 9, 1 / 25, 5 / 7],
                [3 / 8, 2 / 9, 6 / 25, 6 / 7],
                [7 / 8, 5 / 9, 11 / 25, 1 / 49],
                [1 / 16, 8 / 9, 16 / 25, 8 / 49],
            ],
            atol=1e-7,
        )

    def test_equals_scipy(self):
        reference = stats.qmc.Halton(30, scramble=False).random(1001)[1:]
        np.testing.assert_allclose(points(Halton(False), 30, 1000), reference, atol=2e-7)

    def test_points_and_bases_can_be_skipped(self):
        # Conformance case halton-02: sample_index counts from 0 and its first point has index 1.
        whole = points(Halton(scramble=False), 5, 40)
        np.testing.assert_array_equal(points(Halton(skip_points=7), 5, 33), whole[7:])
        np.testing.assert_array_equal(points(Halton(skip_bases=2), 3, 40), whole[:, 2:])
        skipping = Halton(skip_points=2**31, skip_bases=4)
        expected = [[exact_inverse(2**31 + i, base) for base in (11, 13)] for i in range(1, 9)]
        np.testing.assert_allclose(points(skipping, 2, 8), expected, atol=2e-7)

    def test_large_bases_are_scrambled_by_default(self):
        plain = points(Halton(False, skip_bases=4), 5, 20)
        assert not np.allclose(points(Halton(skip_bases=4), 5, 20), plain)
        np.testing.assert_array_equal(
            points(Halton(skip_bases=4), 4, 20), points(Halton(False, skip_bases=4), 4, 20)
        )

    def test_skipping_is_part_of_the_record_of_a_search(self):
        search = Halton(skip_points=3, skip_bases=1)
        assert from_json(to_json(search)) == search
        # As it was recorded before there was anything to skip.
        assert from_json({"name": "halton", "options": {"scramble": None}}) == Halton()

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"skip_points": -1}, "skip_points must be an integer of at least 0; got -1"),
            ({"skip_bases": 1.5}, r"skip_bases must be an integer of at least 0; got 1\.5"),
            ({"skip_points": 2**31 + 1}, "skip_points must be at most 2147483648; got 2147483649"),
            ({"skip_bases": 10**6}, "skip_bases must be at most 10000; got 1000000"),
        ],
    )
    def test_what_cannot_be_skipped(self, options, message):
        with unchecked(), pytest.raises(ValueError, match=message):
            Halton(**options)

    def test_large_indices(self):
        index = [2**24 + 1, 123_456_789, 2**31 - 2, 2**31 - 1, 2**32 - 1]
        u = np.asarray(halton_points(jnp.array(index, jnp.uint32), 5))
        expected = [[exact_inverse(i, base) for base in primes(5)] for i in index]
        np.testing.assert_allclose(u, expected, atol=2e-7)
        assert np.all(u < 1)

    @pytest.mark.parametrize("search", [Halton(), Halton(scramble=True)])
    def test_each_cell_gets_its_share(self, search):
        # b^k points in a row fall one into each cell of width b^-k, scrambled or not.
        u = points(search, 2, 3**4 * 2**4)
        for j, cells in ((0, 2**4), (1, 3**4)):
            counts = np.bincount((u[:, j] * cells).astype(int), minlength=cells)
            assert counts.min() >= len(u) // cells - 1
            assert counts.max() <= len(u) // cells + 1

    @pytest.mark.thorough
    def test_scrambled_coordinates_do_not_run_in_step(self):
        def together(u):
            return np.max(np.abs(np.corrcoef(u[:, -10:].T) - np.eye(10)))

        plain, default = points(Halton(False), 40, 150), points(Halton(), 40, 150)
        assert together(plain) > 0.7
        # Independent points would give 0.08 as standard deviation.
        assert together(default) < 0.4

    def test_is_more_even_than_random(self):
        even = stats.qmc.discrepancy(points(Halton(), 4, 256))
        assert even < 0.35 * stats.qmc.discrepancy(points(Uniform(), 4, 256))

    def test_primes_are_the_first_ones(self):
        assert primes(6) == [2, 3, 5, 7, 11, 13]
        assert primes(0) == []
        assert primes(200)[-1] == 1223
        assert primes(1000)[-1] == 7919


class TestUniform:
    def test_is_uniform(self):
        u = points(Uniform(), 3, 4000)
        for j in range(3):
            assert stats.kstest(u[:, j], "uniform").pvalue > 1e-3
        assert np.max(np.abs(np.corrcoef(u.T) - np.eye(3))) < 0.06

    def test_points_differ(self):
        u = points(Uniform(), 1, 2000)
        assert len(np.unique(u)) > 1990


@pytest.mark.thorough
@pytest.mark.parametrize("dim", [0, 1, 5, 40])
def test_halton_points_are_the_same_in_a_loop_and_written_out(dim, monkeypatch):
    index = np.arange(64, dtype=np.uint32) * 977_771 + 1
    for key in (None, jax.random.key(dim)):
        points = []
        for most in (2**14, -1):
            monkeypatch.setattr("verifai_jax.search.halton.MAX_IN_LOOP", most)
            points.append(np.asarray(jax.jit(lambda i, key=key: halton_points(i, dim, key))(index)))
        # Which products and sums are joined to one operation is the compiler's choice.
        np.testing.assert_allclose(*points, rtol=5e-7, atol=1.2e-7)
