import jax
import pytest

_NAMES = []


def _compiled(event, _, **about):
    if event == "/jax/core/compile/backend_compile_duration":
        _NAMES.append(about.get("fun_name"))


jax.monitoring.register_event_duration_secs_listener(_compiled)


@pytest.fixture
def compiled():
    """Names of what JAX compiles from now on, in the order in which it does."""
    _NAMES.clear()
    return _NAMES
