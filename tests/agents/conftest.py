"""Fixtures that tests of agents share."""

import numpy as np
import pytest


@pytest.fixture
def film():
    """Five frames of three environments, (time, environment, 64, 64, 3)."""
    return np.random.default_rng(0).integers(0, 256, (5, 3, 64, 64, 3), dtype=np.uint8)
