"""The closed loop that the auxiliary model simulates: which controller, which reference, which first parameters."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from configs import ConfigError, DataError, RobotConfig
from identify.controller.crc import IdentifiedController, identify_crc
from identify.controller.nominal import known_controller, nominal_controller, saturation
from identify.estimators.auxiliary import AuxiliaryModel
from identify.experiment import Experiment
from identify.model.arm import ArmModel
from identify.model.controller import DiscreteController
from identify.options import Options
from identify.preparation import PIV_CUTOFF
from identify.signals.bandpass import butterworth
from identify.signals.decimate import Decimation
from identify.signals.differentiate import Derivatives

RUNAWAY = 3.0
"""A simulated joint that is this many times faster than the measured one ever was has diverged."""

RELEVANT = 0.3
"""Relative velocity error of the auxiliary model below which its instruments are relevant enough."""

Array = NDArray[np.float64]


def closed_loop(
    model: ArmModel,
    experiments: Sequence[Experiment],
    signals: Sequence[Derivatives],
    options: Options,
    ls: Array,
    decimation: Decimation,
    bandwidth: float,
    warnings: list[str],
) -> tuple[AuxiliaryModel, Array, dict[str, Any]]:
    """The first closed loop that runs and moves like the robot, the theta it starts from, and what it is."""
    dt = experiments[0].dt
    starts = [("idim-ls", ls), ("initial_parameters", initial_parameters(model))]
    fastest = RUNAWAY * np.max([np.abs(s.qd).max(axis=0) for s in signals], axis=0) + 1e-3
    surrogate = [butterworth(s.q, dt, min(PIV_CUTOFF * bandwidth, 0.4 / dt)) for s in signals]
    closest: tuple[float, AuxiliaryModel, Array, dict[str, Any]] | None = None
    for controller, references, description in _controllers(
        model, experiments, signals, options, ls, bandwidth, surrogate
    ):
        for origin, start in starts:
            auxiliary = AuxiliaryModel(
                model, controller, references, [(s.q[0], s.qd[0]) for s in signals], dt, decimation, fastest
            )
            runs = auxiliary.simulate(start)
            if runs is None:
                continue
            miss = float(
                np.sqrt(
                    sum(np.sum((r.qd - s.qd) ** 2) for r, s in zip(runs, signals, strict=True))
                    / sum(np.sum(s.qd**2) for s in signals)
                )
            )
            found = description | {"start": origin, "velocity_error_pct": 100 * miss}
            if closest is None or miss < closest[0]:
                closest = (miss, auxiliary, start, found)
            break
        if closest is not None and closest[0] < RELEVANT:
            break
    if closest is None:
        raise DataError("no closed loop could be simulated: it diverges with every controller and start tried")
    _, auxiliary, start, found = closest
    if found["kind"] == "nominal":
        warnings.append(found["reason"])
    return auxiliary, start, found


def _controllers(
    model: ArmModel,
    experiments: Sequence[Experiment],
    signals: Sequence[Derivatives],
    options: Options,
    ls: Array,
    bandwidth: float,
    surrogate: Sequence[Array],
) -> Iterator[tuple[DiscreteController, Sequence[Array], dict[str, Any]]]:
    """Controllers with their references, the preferred one first, a stiff stand-in last."""
    robot, dt = model.robot, experiments[0].dt
    references = [e.q_ref for e in experiments if e.q_ref is not None]
    reason = "no reference trajectory in the recording: instruments from a simulation that follows the smoothed motion"
    if len(references) == len(experiments):
        if options.controller == "known":
            yield known_controller(robot, dt), references, {"kind": "known"}
        else:
            ratios = robot.transmission_matrix
            found = identify_crc(
                [e.q @ ratios.T for e in experiments],
                [r @ ratios.T for r in references],
                [e.tau @ np.linalg.inv(ratios) for e in experiments],
                dt,
                saturation=saturation(robot),
            )
            yield found.controller, references, {"kind": "crc"} | _describe(found, robot)
        reason = "the identified controller does not move the simulated arm like the real one: a stiff stand-in is used"
    stand_in = nominal_controller(
        model, ls, np.concatenate([s.q[:: max(1, s.q.shape[0] // 200)] for s in signals]), dt, bandwidth
    )
    yield stand_in, surrogate, {"kind": "nominal", "reason": reason, "error_taps": stand_in.error_taps.tolist()}


def _describe(found: IdentifiedController, robot: RobotConfig) -> dict[str, Any]:
    return {
        "joints": [
            {
                "joint": joint.name,
                "error_taps": r.error_taps.tolist(),
                "position_taps": r.position_taps.tolist(),
                "prewhitening_order": r.prewhitening_order,
                "fit_pct": r.fit_pct,
            }
            for joint, r in zip(robot.joints, found.responses, strict=True)
        ]
    }


def initial_parameters(model: ArmModel) -> Array:
    """Base parameters of the configuration's ``initial_parameters`` (standard names), the rest zero."""
    standard = np.zeros(len(model.names))
    for name, value in model.robot.initial_parameters.items():
        if name not in model.names:
            raise ConfigError(f"initial_parameters: {model.robot.name} has no standard parameter {name!r}")
        standard[model.names.index(name)] = value
    theta: Array = model.base.regroup @ standard
    return theta
