"""A cache folder for the libraries of native code, which the other tests do without."""

import shutil

import pytest

from verifai_jax.addons.native.native_code.machine_code import COMPILERS


@pytest.fixture(scope="module", autouse=True)
def _cache(tmp_path_factory):
    """Libraries of these tests are their own, and compiled here."""
    if not any(map(shutil.which, COMPILERS)):
        pytest.skip("there is no C++ compiler")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VERIFAI_JAX_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield
