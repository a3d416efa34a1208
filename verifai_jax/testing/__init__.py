"""Contract suites: run them on domains, searches and systems of your own.

    check_domain(MyDomain(...))                          # round trips, shapes, table columns
    check_search(MySearch(...), Cube((0, 0, 4)))         # init / ask / tell
    check_system(my_simulator, space)                    # one clock, same alone and in batches
    check_forks(my_simulator, space)                     # what stops and goes on is undisturbed

Each raises `AssertionError` that says which law is broken.

    @given(strategy(space))                             # features for tests of Hypothesis
    def test_keeps_lane(features): ...
"""

from typing import TYPE_CHECKING

from verifai_jax.core.display.lazy import attach

if TYPE_CHECKING:
    from verifai_jax.testing.domains import check_domain as check_domain
    from verifai_jax.testing.forks import check_forks as check_forks
    from verifai_jax.testing.searches import check_batch_independence as check_batch_independence
    from verifai_jax.testing.searches import check_search as check_search
    from verifai_jax.testing.strategies import strategy as strategy
    from verifai_jax.testing.systems import check_system as check_system
# Imported when first used: a folder inside needs few of these names.
__getattr__, __dir__, __all__ = attach(__name__)
