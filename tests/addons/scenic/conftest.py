"""What tests of programs need."""

import pytest


@pytest.fixture
def installed():
    """Skip a test where Scenic is not installed."""
    pytest.importorskip("scenic")
