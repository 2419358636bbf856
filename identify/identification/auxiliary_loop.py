"""The closed loop that the auxiliary model simulates: which controller, which reference, which first parameters."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, DataError, RobotConfig
from armident.identify.controller.crc import JointResponse, identify_crc
from armident.identify.controller.nominal import known_controller, nominal_controller, saturation
from armident.identify.controller.parametric import ControlLaw, identify_parametric
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.estimators.measured_instruments import MotionInstruments
from armident.identify.experiment import Experiment
from armident.identify.identification.equations import PIV_CUTOFF
from armident.identify.identification.options import Options
from armident.identify.identification.solvers import MEASURED
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.controller import DiscreteController
from armident.identify.robot.simulation import Simulation
from armident.identify.signals.bandpass import butterworth
from armident.identify.signals.decimate import Decimation
from armident.identify.signals.differentiate import Derivatives

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
    without: str | None = None,
) -> tuple[AuxiliaryModel, Array, dict[str, Any]]:
    """The first closed loop that runs and moves like the robot, the theta it starts from, and what it is.

    ``without`` is a kind of controller that is passed over.
    """
    dt = experiments[0].dt
    starts = [("idim-ls", ls), ("initial_parameters", initial_parameters(model))]
    fastest = RUNAWAY * np.max([np.abs(s.qd).max(axis=0) for s in signals], axis=0) + 1e-3

    @cache
    def surrogate() -> list[Array]:
        return [butterworth(s.q, dt, min(PIV_CUTOFF * bandwidth, 0.4 / dt)) for s in signals]

    closest: tuple[float, AuxiliaryModel, Array, dict[str, Any]] | None = None
    for controller, references, description in _controllers(
        model, experiments, signals, options, ls, bandwidth, surrogate, without
    ):
        for origin, start in starts:
            auxiliary = AuxiliaryModel(
                model,
                controller,
                references,
                [(s.q[0], s.qd[0]) for s in signals],
                dt,
                decimation,
                fastest,
                anchor=start,
                # Methods without a measured regressor have the torque's band in both their sides.
                band_hz=PIV_CUTOFF * bandwidth if options.method in MEASURED else np.inf,
                starts=[e.start for e in experiments],
            )
            runs = auxiliary.simulate(start)
            if runs is None:
                continue
            miss = velocity_error(runs, signals)
            found = description | {"start": origin, "velocity_error_pct": 100 * miss}
            if closest is None or miss < closest[0]:
                closest = (miss, auxiliary, start, found)
            break
        if closest is not None and closest[0] < RELEVANT:
            break
    if closest is None:
        if options.method not in MEASURED or options.noise_model == "grey-box":
            raise DataError("no closed loop could be simulated: it diverges with every controller and start tried")
        reason = "no closed loop could be simulated with this estimate: instruments from the smoothed motion itself"
        warnings.append(reason)
        return MotionInstruments.of(model, surrogate(), dt, decimation), ls, {"kind": "followed", "reason": reason}
    _, auxiliary, start, found = closest
    if found["kind"] == "nominal":
        warnings.append(found["reason"])
    return auxiliary, start, found


def velocity_error(runs: Sequence[Simulation], signals: Sequence[Derivatives]) -> float:
    """Norm of the difference of simulated and smoothed velocities over that of the smoothed ones."""
    apart = [float(np.linalg.norm(run.qd - s.qd)) for run, s in zip(runs, signals, strict=True)]
    return float(np.linalg.norm(apart) / np.linalg.norm([np.linalg.norm(s.qd) for s in signals]))


def _controllers(
    model: ArmModel,
    experiments: Sequence[Experiment],
    signals: Sequence[Derivatives],
    options: Options,
    ls: Array,
    bandwidth: float,
    surrogate: Callable[[], Sequence[Array]],
    without: str | None,
) -> Iterator[tuple[DiscreteController, Sequence[Array], dict[str, Any]]]:
    """Controllers with their references, the preferred one first, a stiff stand-in last."""
    robot, dt = model.robot, experiments[0].dt
    references = [e.q_ref for e in experiments if e.q_ref is not None]
    reason = "no reference trajectory in the recording: instruments from a simulation that follows the smoothed motion"
    if len(references) == len(experiments):
        if options.controller == without:
            pass
        elif options.controller == "known":
            yield known_controller(robot, dt), references, {"kind": "known"}
        else:
            yield _identified(robot, experiments, references, options, dt)
        reason = "the identified controller does not move the simulated arm like the real one: a stiff stand-in is used"
    postures = np.concatenate([s.q[:: max(1, s.q.shape[0] // 200)] for s in signals])
    try:
        stand_in = nominal_controller(model, ls, postures, dt, bandwidth)
    except DataError:
        # Inertias that are not positive: no gain can be chosen by them.
        return
    yield stand_in, surrogate(), {"kind": "nominal", "reason": reason, "error_taps": stand_in.error_taps.tolist()}


def _identified(
    robot: RobotConfig, experiments: Sequence[Experiment], references: Sequence[Array], options: Options, dt: float
) -> tuple[DiscreteController, Sequence[Array], dict[str, Any]]:
    """Every motor's controller from position, reference and torque at its shaft."""
    ratios = robot.transmission_matrix
    to_motor = np.linalg.inv(ratios)
    q, wanted = [e.q @ ratios.T for e in experiments], [r @ ratios.T for r in references]
    tau = [e.tau @ to_motor for e in experiments]
    if options.controller == "crc":
        found = identify_crc(q, wanted, tau, dt, saturation=saturation(robot))
    else:
        gain = np.array([joint.drive.gain for joint in robot.joints])
        found = identify_parametric(q, wanted, tau, dt, saturation=saturation(robot), gain=gain)
    described = [
        {"joint": joint.name} | _description(response)
        for joint, response in zip(robot.joints, found.responses, strict=True)
    ]
    return found.controller, references, {"kind": options.controller, "joints": described}


def _description(response: JointResponse) -> dict[str, Any]:
    found: dict[str, Any] = {
        "error_taps": response.error_taps.tolist(),
        "position_taps": response.position_taps.tolist(),
        "prewhitening_order": response.prewhitening_order,
        "fit_pct": response.fit_pct,
    }
    if isinstance(response, ControlLaw):
        found |= {
            "output_taps": response.output_taps.tolist(),
            "structure": asdict(response.structure),
            "gains": {name: asdict(gain) for name, gain in response.gains.items()},
            "saturated_samples": response.saturated,
            "iterations": response.iterations,
            "converged": response.converged,
        }
    return found


def initial_parameters(model: ArmModel) -> Array:
    """Base parameters of the configuration's ``initial_parameters`` (standard names), the rest zero."""
    standard = np.zeros(len(model.names))
    for name, value in model.robot.initial_parameters.items():
        if name not in model.names:
            raise ConfigError(f"initial_parameters: {model.robot.name} has no standard parameter {name!r}")
        standard[model.names.index(name)] = value
    theta: Array = model.base.regroup @ standard
    return theta
