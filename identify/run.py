"""Identification of an experiment from beginning to end: what `armident identify` and the worker both call."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from configs import DataError, RobotConfig
from identify.closed_loop import closed_loop
from identify.estimators.auxiliary import AuxiliaryModel
from identify.estimators.idim_iv import idim_iv
from identify.estimators.idim_ls import idim_ls
from identify.estimators.idim_piv import idim_piv
from identify.estimators.regression import Block, Estimate
from identify.experiment import Experiment
from identify.model.arm import ArmModel
from identify.options import Options
from identify.preparation import LS_CUTOFF, PIV_CUTOFF, equations, published_equations
from identify.result import Array, Identification, make_result
from identify.signals.bandwidth import motion_bandwidth
from identify.signals.decimate import Decimation, design
from identify.signals.differentiate import differentiate

CONTRADICTION = 5.0
"""Standard deviations by which IDIM-PIV may differ from IDIM-IV in any parameter before it is disbelieved."""

Progress = Callable[[str, float], None]


def identify_experiment(
    experiments: Sequence[Experiment] | Experiment,
    robot: RobotConfig,
    options: Options | None = None,
    progress: Progress | None = None,
) -> Identification:
    """Identify the base parameters of a robot.

    The steps are the thesis's: derivatives (5.1), IDIM-LS (2.3.2), controller (5.2), auxiliary closed loop, IDIM-IV
    (2.3.3) or IDIM-PIV (6.2.2). IDIM-LS is always computed: it starts the iterations and stands beside their result.

    Parameters
    ----------
    experiments
        One or more recordings of the same robot at one sampling rate.
    robot
        Its configuration.
    options
        See :class:`Options`.
    progress
        Called with a stage and the share done, 0 to 1.

    Raises
    ------
    ConfigError
        If ``controller='known'`` and the configuration has none.
    DataError
        If the data cannot support the request: too short, not finite, motion that leaves parameters undetermined.
    """
    options = options or Options()
    experiments = [experiments] if isinstance(experiments, Experiment) else list(experiments)
    _check(experiments, robot)
    clock = _Clock(progress or (lambda stage, share: None))
    warnings: list[str] = []

    clock.enter("model", 0.0)
    model = ArmModel.from_config(robot)
    dt = experiments[0].dt
    bandwidth = options.bandwidth_hz or robot.bandwidth_hz or motion_bandwidth([e.q for e in experiments], dt)

    clock.enter("derivatives", 0.05)
    method = options.derivatives or "irwsm"
    signals = [differentiate(e.q, dt, method, options.nvr, bandwidth) for e in experiments]

    clock.enter("idim-ls", 0.2)
    factor = options.decimation if options.method != "idim-piv" else None
    ls_decimation = design(dt, _cutoff(dt, LS_CUTOFF * bandwidth, factor), factor)
    if options.derivatives is None and options.decimation is None and robot.preprocessing is not None:
        ls_blocks = published_equations(model, experiments, robot.preprocessing)
    else:
        ls_blocks = equations(model, experiments, signals, ls_decimation)
    ls = idim_ls(ls_blocks, model.base.names)

    controller: dict[str, Any] = {"kind": "none"}
    if options.method == "idim-ls":
        estimate, blocks = ls, ls_blocks
    else:
        clock.enter("controller", 0.35)
        if options.method == "idim-piv":
            decimation = design(dt, _cutoff(dt, PIV_CUTOFF * bandwidth, options.decimation), options.decimation)
        else:
            decimation = ls_decimation
        blocks = equations(model, experiments, signals, decimation)
        auxiliary, start, controller = closed_loop(
            model, experiments, signals, options, ls.theta, decimation, bandwidth, warnings
        )
        clock.enter(options.method, 0.5)
        if options.method == "idim-iv":
            estimate = idim_iv(blocks, auxiliary, start)
        else:
            plain_blocks = equations(model, experiments, signals, ls_decimation)
            estimate, blocks = _prefiltered(
                blocks, auxiliary, plain_blocks, ls_decimation, start, options, model.base.names, warnings
            )
        warnings += estimate.warnings
        if not estimate.converged:
            warnings.append(f"{options.method} did not converge: {estimate.stop_reason}")

    clock.enter("statistics", 0.9)
    result = make_result(options, model, estimate, blocks, ls, ls_blocks, controller, warnings, clock.spent)
    clock.done()
    return result


@dataclass
class _Clock:
    """Reports stages and how long each took."""

    report: Progress
    spent: dict[str, float] = field(default_factory=dict)
    _stage: str = ""
    _since: float = 0.0
    _begin: float = field(default_factory=time.perf_counter)

    def enter(self, stage: str, share: float) -> None:
        self._close()
        self._stage, self._since = stage, time.perf_counter()
        self.report(stage, share)

    def done(self) -> None:
        self._close()
        self.spent["total"] = time.perf_counter() - self._begin
        self.report("done", 1.0)

    def _close(self) -> None:
        if self._stage:
            self.spent[self._stage] = time.perf_counter() - self._since


def _check(experiments: Sequence[Experiment], robot: RobotConfig) -> None:
    if not experiments:
        raise DataError("no experiment to identify from")
    for number, e in enumerate(experiments, start=1):
        for name, values in (("position", e.q), ("torque", e.tau), ("reference", e.q_ref)):
            if values is None:
                continue
            if values.ndim != 2 or values.shape != (e.q.shape[0], robot.n):
                raise DataError(
                    f"experiment {number}: {name} has shape {values.shape}, {robot.name} has {robot.n} joints"
                )
            bad = ~np.isfinite(values)
            if bad.any():
                k, j = np.argwhere(bad)[0]
                raise DataError(f"experiment {number}: {name} of {robot.joints[j].name} is not finite at sample {k}")
        if e.dt != experiments[0].dt:
            raise DataError("the experiments have different sampling rates")


def _cutoff(dt: float, wanted: float, factor: int | None) -> float:
    """Cut-off (Hz) of a decimation: as wanted, or what a factor given by hand leaves."""
    return wanted if factor is None else 0.5 / (dt * factor)


def _prefiltered(
    blocks: list[Block],
    auxiliary: AuxiliaryModel,
    plain_blocks: list[Block],
    plain_decimation: Decimation,
    start: Array,
    options: Options,
    names: Sequence[str],
    warnings: list[str],
) -> tuple[Estimate, list[Block]]:
    """IDIM-PIV, unless the prefilter contradicts IDIM-IV.

    A noise model may move the estimate within its uncertainty only. Where it moves it further, the residual
    is not noise but what the model lacks, and its inverse filter amplifies that (thesis section 6.2.3); then, as in
    SEP-PEM, the dynamic model is estimated without it and it only enters the covariance (6.2.1).
    """
    plain_auxiliary = replace(auxiliary, decimation=plain_decimation, warnings=[])
    plain = idim_iv(plain_blocks, plain_auxiliary, start, serial_order=options.max_ar_order)
    estimate = idim_piv(blocks, auxiliary, plain.theta, max_order=options.max_ar_order)
    shift = np.abs(estimate.theta - plain.theta) / plain.std
    worst = int(np.argmax(shift))
    if shift[worst] <= CONTRADICTION:
        return estimate, blocks
    warnings.append(
        f"the prefilter of idim-piv moves {names[worst]} by {shift[worst]:.0f} standard deviations from "
        "idim-iv: the residuals are model error, not noise; the parameters are those of idim-iv, the noise model only "
        "enters their standard deviations"
    )
    return plain, plain_blocks
