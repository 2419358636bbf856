"""An arm of three joints and its healthy recordings, for the tests of the set-up check."""

import pytest

from armident.configs import RobotConfig
from armident.identify.signals.experiments import Experiment
from tests.fixtures import setups


@pytest.fixture(scope="module")
def arm() -> RobotConfig:
    """Return the arm."""
    return setups.random_arm(3, 3)


@pytest.fixture(scope="module")
def healthy(arm: RobotConfig) -> list[Experiment]:
    """Return recordings of the arm in the right set-up."""
    return setups.record(arm, 0)
