"""The robots that many tests are about."""

import pytest

from armident.configs import RobotConfig, load_robot


@pytest.fixture(scope="session")
def tx40() -> RobotConfig:
    return load_robot("tx40.yaml")


@pytest.fixture(scope="session")
def emps() -> RobotConfig:
    return load_robot("emps.yaml")
