"""Thesis section 5.3.3 on an axis with velocity feedback: IDIM-IV and DIDIM with an impulse response."""

from dataclasses import dataclass

import numpy as np

from armident.identify.controller.crc import identify_crc
from armident.identify.controller.parametric import identify_parametric
from armident.identify.effects.terms import arm_model
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.estimators.didim import didim
from armident.identify.estimators.idim_iv import idim_iv
from armident.identify.estimators.idim_ls import idim_ls
from armident.identify.identification.auxiliary_loop import RUNAWAY
from armident.identify.identification.equations import LS_CUTOFF, equations
from armident.identify.regression.equations import Estimate
from armident.identify.signals.decimate import design
from armident.identify.signals.differentiate import differentiate
from tests.reproduction.recordings import Recorded

MODE_HZ = 20.0
"""Highest mode of the closed loop, Hz (thesis section 5.1.4)."""
LENGTH = 10
"""Length of the impulse response, samples. It explains as much as 20, with which the virtual loop is unstable."""


@dataclass(frozen=True)
class Controllers:
    """Estimates with the identified law (``C``) and with the impulse response from the tracking error (``CRC``).

    ``fit_pct`` is the share of the torque that the impulse response explains on held-out data, percent.
    """

    idim_iv: tuple[Estimate, Estimate]
    didim: tuple[Estimate, Estimate]
    fit_pct: float


def controllers_on_emps(recorded: Recorded) -> Controllers:
    """Run IDIM-IV and DIDIM on EMPS with both identified controllers (thesis sections 5.2.2 and 5.2.3)."""
    experiment = recorded.experiment
    assert experiment.q_ref is not None
    model, dt = arm_model(recorded.robot), experiment.dt
    signals = differentiate(experiment.q, dt)
    decimation = design(dt, LS_CUTOFF * MODE_HZ)
    blocks = equations(model, [experiment], [signals], decimation)
    start = idim_ls(blocks, model.base.names).theta
    law = identify_parametric([experiment.q], [experiment.q_ref], [experiment.tau], dt)
    response = identify_crc(
        [experiment.q], [experiment.q_ref], [experiment.tau], dt, length=LENGTH, velocity_loop=False
    )
    loops = [
        AuxiliaryModel(
            model=model,
            controller=found.controller,
            references=[experiment.q_ref],
            initial=[(signals.q[0], signals.qd[0])],
            dt=dt,
            decimation=decimation,
            max_velocity=RUNAWAY * np.abs(signals.qd).max(axis=0),
        )
        for found in (law, response)
    ]
    instrumental, direct = ([method(blocks, loop, start) for loop in loops] for method in (idim_iv, didim))
    return Controllers((instrumental[0], instrumental[1]), (direct[0], direct[1]), response.responses[0].fit_pct)
