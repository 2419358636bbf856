"""Choice of the closed loop that the auxiliary model simulates: controller, references and first parameters."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from armident.arrays import Array
from armident.configs import ConfigError, DataError, RobotConfig
from armident.identify.controller.crc import JointResponse, identify_crc
from armident.identify.controller.nominal import known_controller, nominal_controller, saturation
from armident.identify.controller.parametric import ControlLaw, identify_parametric
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.estimators.measured_instruments import MotionInstruments
from armident.identify.estimators.methods import estimator
from armident.identify.identification.equations import PIV_CUTOFF, Prepared
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.identification.options import CONTROLLERS, Options
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.controller import DiscreteController
from armident.identify.robot.simulation import Simulation
from armident.identify.signals.bandpass import butterworth
from armident.identify.signals.decimate import Decimation
from armident.identify.signals.differentiate import Derivatives, differentiate
from armident.identify.signals.experiments import Experiment
from armident.identify.signals.streamed import kept, mapped

RUNAWAY = 3.0
"""Speed of a simulated joint, over the highest measured speed, beyond which the simulation has diverged: a stable loop
oversteps its set points by less than their own speed, so that it stays below two."""

NO_REFERENCE = (
    "There is no reference trajectory in the recording. Instruments: simulation of a stiff PD controller that "
    "tracks the smoothed measured motion."
)
NOT_LIKE_THE_ROBOT = (
    "The identified controller does not move the simulated arm like the robot. A stiff PD controller is used."
)


class ClosedLoop(NamedTuple):
    """The simulated closed loop of an estimator, first theta (b,), and why a preferred controller was not used."""

    auxiliary: AuxiliaryModel
    start: Array
    controller: dict[str, Any]
    warnings: tuple[str, ...] = ()


def closed_loop(
    prepared: Prepared,
    options: Options,
    ls: Array,
    decimation: Decimation,
    bandwidth: float,
    excluded: str | None = None,
) -> ClosedLoop:
    """Return the first closed loop whose simulation runs and moves like the robot (thesis 5.2)."""
    model, experiments, signals = prepared.model, prepared.experiments, prepared.signals
    dt = experiments[0].dt
    starts = [("idim-ls", ls), ("initial_parameters", initial_parameters(model))]
    fastest = RUNAWAY * np.max([np.abs(s.qd).max(axis=0) for s in signals], axis=0) + 1e-3

    @cache
    def smoothed_motion() -> Sequence[Array]:
        return kept((butterworth(s.q, dt, min(PIV_CUTOFF * bandwidth, 0.4 / dt)) for s in signals), like=signals)

    closest: tuple[float, ClosedLoop] | None = None
    for controller, references, description in _controllers(
        prepared, options, ls, bandwidth, smoothed_motion, excluded
    ):
        for origin, start in starts:
            auxiliary = AuxiliaryModel(
                model,
                controller,
                references,
                [(s.q[0].copy(), s.qd[0].copy()) for s in signals],
                dt,
                decimation,
                fastest,
                anchor=start,
                # Methods without a measured regressor have the torque's band in both their sides.
                band_hz=PIV_CUTOFF * bandwidth if estimator(options.method).measured else np.inf,
                starts=[e.start for e in experiments],
                measured=_bandpassed(options, bandwidth, dt),
                feedback=description["kind"] in CONTROLLERS,
            )
            runs = auxiliary.simulate(start)
            if runs is None:
                continue
            error = velocity_error(runs, signals)
            if closest is None or error < closest[0]:
                found = description | {"start": origin, "velocity_error_pct": 100 * error}
                closest = error, ClosedLoop(auxiliary, start, found)
            break
        if closest is not None and closest[0] < IdentificationCriteria.max_velocity_error:
            break
    if closest is None:
        if not estimator(options.method).measured or options.noise_model == "grey-box":
            raise DataError(
                f"{options.method} needs a simulated closed loop, which diverges with every controller and start "
                "tried. Next: judge the recording by --method idim-ls, or armident check RECORDING"
            )
        reason = "No closed loop can be simulated with this estimate. Instruments: the smoothed measured motion."
        instruments = MotionInstruments.of(model, smoothed_motion(), dt, decimation)
        return ClosedLoop(instruments, ls, {"kind": "followed", "reason": reason})
    loop = closest[1]
    return loop._replace(warnings=(loop.controller["reason"],)) if loop.controller["kind"] == "nominal" else loop


def _bandpassed(options: Options, bandwidth: float, dt: float) -> Callable[[Array, int], Derivatives] | None:
    """The bandpass of the measured positions, for the instruments; ``None`` where another filter was chosen."""
    if options.derivatives != "bandpass" or not estimator(options.method).measured:
        return None
    return lambda q, _: differentiate(q, dt, "bandpass", bandwidth_hz=bandwidth)


def velocity_error(runs: Sequence[Simulation], signals: Sequence[Derivatives]) -> float:
    """Norm of the difference of simulated and smoothed velocities over that of the smoothed ones."""
    differences = [float(np.linalg.norm(run.qd - s.qd)) for run, s in zip(runs, signals, strict=True)]
    return float(np.linalg.norm(differences) / np.linalg.norm([np.linalg.norm(s.qd) for s in signals]))


def _controllers(
    prepared: Prepared,
    options: Options,
    ls: Array,
    bandwidth: float,
    smoothed_motion: Callable[[], Sequence[Array]],
    excluded: str | None,
) -> Iterator[tuple[DiscreteController, Sequence[Array], dict[str, Any]]]:
    """Controllers with their references, the preferred one first, a stiff PD controller last."""
    model, experiments = prepared.model, prepared.experiments
    dt = experiments[0].dt
    reason = NO_REFERENCE
    if all(e.q_ref is not None for e in experiments):
        references = mapped(lambda e: e.q_ref, experiments)
        if options.controller == excluded:
            pass
        elif options.controller == "known":
            yield known_controller(model.robot, dt), references, {"kind": "known"}
        else:
            yield _identified(model.robot, experiments, references, options, dt)
        reason = NOT_LIKE_THE_ROBOT
    postures = np.concatenate([s.q[:: max(1, s.q.shape[0] // 200)].copy() for s in prepared.signals])
    try:
        stiff = nominal_controller(model, ls, postures, dt, bandwidth)
    except DataError:
        # Inertias that are not positive: no gains can be chosen for them.
        return
    yield stiff, smoothed_motion(), {"kind": "nominal", "reason": reason, "error_taps": stiff.error_taps.tolist()}


def _identified(
    robot: RobotConfig, experiments: Sequence[Experiment], references: Sequence[Array], options: Options, dt: float
) -> tuple[DiscreteController, Sequence[Array], dict[str, Any]]:
    """Controller of every motor, identified from position, reference and torque at its shaft (thesis 5.2)."""
    ratios = robot.transmission_matrix
    to_motor = np.linalg.inv(ratios)
    q, wanted = mapped(lambda e: e.q @ ratios.T, experiments), mapped(lambda r: r @ ratios.T, references)
    tau = mapped(lambda e: e.tau @ to_motor, experiments)
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
    """Base parameters (b,) of ``initial_parameters``, the rest zero; raises ConfigError if a name is unknown."""
    standard = np.zeros(len(model.names))
    for name, value in model.robot.initial_parameters.items():
        if name not in model.names:
            raise ConfigError(f"initial_parameters: {model.robot.name} has no standard parameter {name!r}")
        standard[model.names.index(name)] = value
    theta: Array = model.base.regroup @ standard
    return theta
