"""How much faster than real time the virtual arm computes: plant and six drives, one control period of 200 us."""

import numpy as np

from armident.configs import load_robot
from armident.virtual_robot.arm import Arm
from armident.virtual_robot.inertias import rest_posture
from armident.virtual_robot.servo import CONTROL_PERIOD
from tests.benchmarks.harness import Row, best_of

PERIODS = 10_000


def run() -> list[Row]:
    """Time two seconds of the arm holding its posture against the clock on the wall."""
    robot = load_robot("tx40.yaml")
    arm = Arm(robot, rest_posture(robot))
    for joint in range(robot.n):
        arm.enable(joint, True)
    arm.advance()

    def hold() -> None:
        for _ in range(PERIODS):
            arm.advance()

    each = best_of(hold) / PERIODS
    sag = float(np.abs(arm.plant.q - rest_posture(robot)).max())
    note = f"without bus; the arm stays within {sag:.3f} rad of its posture"
    return [
        Row("virtual arm, one control period against real time", each * 1e6, 200.0, CONTROL_PERIOD / each, "us", note)
    ]
