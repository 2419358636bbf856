"""A torque that arrives late spoils the identified loop; the diagnosis finds it all the same."""

from dataclasses import asdict
from pathlib import Path

import pytest

from configs.loading import load_suite
from daq.suite.cases import all_cases
from identify.discrepancy import batch
from virtual_robot.batch import record

CASE = "effect time_delay joint_2 obvious tx40 run 1"


@pytest.mark.timeout(600)
def test_a_late_torque_of_joint_2_is_found_in_the_loop_that_it_makes(tmp_path: Path) -> None:
    """A case of the shipped suite whose simulated loop, without the delay, speaks against the delay."""
    (case,) = (case for case in all_cases(load_suite("suite.yaml")) if case.name == CASE)
    (part,) = case.parts
    file = tmp_path / "late.mcap"
    request = {
        "id": case.key,
        "robot": case.config,
        "trajectory": case.trajectory,
        "repeats": case.repeats,
        "period": case.period,
        "seed": case.seed,
        "effects": [asdict(part)],
        "out": str(file),
    }
    (hidden,) = record(request)["truth"]
    told = batch.answer({"id": case.key, "do": "diagnose", "recording": str(file), "robot": case.config})["document"]
    (found,) = told["findings"]
    assert (found["effect"], found["joint"]) == ("time_delay", "joint_2")
    assert abs(found["parameters"]["delay"] - hidden["delay"]) < 3.0 * found["evidence"]["std"]["delay"]
    errors = told["gap"]["validation"]
    assert errors["after"]["all"] < errors["before"]["all"]
    assert told["verdict"] == "explained"
