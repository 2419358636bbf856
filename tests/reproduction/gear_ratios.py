"""Auxiliary model with wrong gear ratios (thesis section 4.2.3)."""

from dataclasses import replace
from typing import TypeVar

from armident.identify.estimators.auxiliary_model import AuxiliaryModel

Loop = TypeVar("Loop", bound=AuxiliaryModel)


def with_gear_ratios(loop: Loop, share: float) -> Loop:
    """Return a loop that is simulated with gear ratios wrong by the factor ``share``.

    Controller, reference and encoders are on the motor side. The simulated joints therefore move ``1 / share`` as far
    as the real ones and receive ``share`` of the torques of the drives.
    """
    robot = loop.model.robot
    ratios = tuple(tuple(share * ratio for ratio in row) for row in robot.transmission_matrix.tolist())
    return replace(
        loop.fresh(),
        model=replace(loop.model, robot=robot.model_copy(update={"transmission": ratios})),
        references=[q_ref / share for q_ref in loop.references],
        initial=[(q / share, qd / share) for q, qd in loop.initial],
        max_velocity=loop.max_velocity / share,
    )
