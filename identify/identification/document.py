"""The document of an identification."""

from collections.abc import Sequence

import numpy as np

from armident.configs import RobotConfig
from armident.identify.documents.base import RecordingReference, plain, versions
from armident.identify.documents.identification import (
    ChangeDirection,
    Comparison,
    IdentificationDocument,
    ResidualStatistics,
    VerdictReason,
    Whiteness,
    parameter,
)
from armident.identify.identification.identification_result import IdentificationResult


def identification_document(
    result: IdentificationResult,
    recordings: Sequence[RecordingReference],
    robot: RobotConfig,
    notes: Sequence[str] = (),
) -> IdentificationDocument:
    """Document of an identification; ``notes`` of the conversion precede the estimator's warnings."""
    joints = [joint.name for joint in robot.joints]
    essential = np.asarray(result.essential, dtype=bool)
    parameters = [
        parameter(name, value, std, unit, bool(keep), result.formulas.get(name))
        for name, value, std, unit, keep in zip(
            result.names, result.theta, result.std, result.units, essential, strict=True
        )
    ]
    comparison = None
    if result.idim_ls is not None and result.method != "idim-ls":
        theta, std = result.idim_ls
        comparison = Comparison(
            method="idim-ls",
            parameters=[
                parameter(name, value, deviation, unit, bool(keep))
                for name, value, deviation, unit, keep in zip(
                    result.names, theta, std, result.units, essential, strict=True
                )
            ],
        )
    return IdentificationDocument(
        verdict=result.verdict.level,
        reasons=[VerdictReason(**plain(reason)) for reason in result.verdict.reasons],
        robot=robot.name,
        recording=recordings[0],
        method=result.method,
        options=plain(result.options),
        parameters=parameters,
        covariance=np.asarray(result.covariance, dtype=float).tolist(),
        relative_error_pct=float(result.relative_error_pct),
        relative_error_pct_by_joint=dict(
            zip(joints, (float(v) for v in result.relative_error_pct_by_joint), strict=True)
        ),
        held_out_error_pct=None if result.held_out is None else result.held_out[0],
        held_out_error_pct_by_joint=None
        if result.held_out is None
        else dict(zip(joints, (float(v) for v in result.held_out[1]), strict=True)),
        iterations=int(result.iterations),
        converged=bool(result.converged),
        stop_reason=result.stop_reason,
        whiteness=[Whiteness(**plain(w)) for w in result.whiteness],
        noise_model=plain(result.noise_model),
        controller=plain(result.controller),
        timing_s={k: float(v) for k, v in result.timing_s.items()},
        versions=versions(),
        warnings=[*notes, *result.warnings],
        comparison=comparison,
        diagnostics=result.diagnostics.document(),
        physical=None if result.physical is None else result.physical.document(),
        torque_delay_samples=None
        if result.delay is None
        else {
            name: [float(samples), float(std)]
            for name, samples, std in zip(joints, result.delay.samples, result.delay.std, strict=True)
        },
        further_recordings=list(recordings[1:]) or None,
        bias=None if result.bias is None else dict(zip(result.names, map(float, result.bias), strict=True)),
        sign_smoothing=dict(zip(joints, (float(g) for g in result.sign_smoothing), strict=True)),
        transitions={name: (one.velocity, one.low, one.high) for name, one in result.transitions.items()} or None,
        criteria=plain(result.criteria),
        residual_statistics=[ResidualStatistics(**plain(each)) for each in result.residual_statistics] or None,
        change_directions=[ChangeDirection(**plain(each)) for each in result.change_directions] or None,
        configuration=robot.model_dump(mode="json", by_alias=True),
    )
