"""First stage of a diagnosis: mistakes of the set-up are corrected and reported before any effect is looked for."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from armident.configs import DataError, RobotConfig
from armident.identify.diagnosis.criteria import Criteria
from armident.identify.documents.diagnosis import Finding, Gap, Unexplained
from armident.identify.identification.from_recording import MIN_PIECE_S
from armident.identify.setup.calibration import NAMED
from armident.identify.setup.check import check_setup
from armident.identify.setup.result import (
    ABOUT_URDF,
    CONVENTIONS,
    WIRED,
    SetupCheck,
    SetupFinding,
    Span,
    with_torque_shift,
)
from armident.identify.signals.experiments import Experiment

EACH = {"position_sign": "sign_error", "torque_sign": "sign_error", "time_shift": "time_delay", "change_in_time": ""}
"""Effect of each joint by kind of finding; empty: the kind itself."""

REMARKS = (
    "rate_too_slow",
    "joint_at_rest",
    "one_direction",
    "torque_held",
    "position_held",
    "position_resolution",
    "unusual_weight",
    *ABOUT_URDF,
)
"""Kinds of finding that become warnings: they limit the recordings and are no mistake of the model."""


@dataclass(frozen=True)
class SetupStage:
    """Recordings and configuration with the set-up corrected (clock and torque shift, too), and the document's entries.

    ``findings``: mistakes of the set-up. ``unexplained``: joints that the rigid model explains in no set-up. ``errors``
    (n,): relative errors of the rigid model as configured, percent. ``shifts``: undecided common shifts of the torques,
    samples.
    """

    training: tuple[Experiment, ...]
    validation: tuple[Experiment, ...]
    robot: RobotConfig
    findings: tuple[Finding, ...]
    unexplained: tuple[Unexplained, ...]
    warnings: tuple[str, ...]
    errors: tuple[float, ...]
    shifts: tuple[float, ...] = ()
    shift_known: bool = False
    criteria: Criteria = field(default_factory=Criteria)

    def as_configured(self, gap: Gap) -> Gap:
        """Gap of the model in the set-up as configured, from that in the corrected one."""
        if not self.findings:
            return gap
        names = list(gap.by_joint)
        after = np.maximum([gap.by_joint[name] for name in names], 1e-12)
        torque = np.array([gap.rms[name] for name in names]) / after
        each = np.maximum(self.errors, after)
        whole = float(np.sqrt(np.sum((each * torque) ** 2) / np.sum(torque**2)))
        return Gap(
            all=whole,
            by_joint=dict(zip(names, (float(v) for v in each), strict=True)),
            rms=dict(zip(names, (float(v) for v in each * torque), strict=True)),
        )

    def doubtful(self, gap: Gap) -> list[Unexplained]:
        """Entries of the joints that the model with the effects found does not explain, either."""
        return [entry for entry in self.unexplained if gap.by_joint[entry.joint] > self.criteria.set_up_doubtful_pct]

    def left(self, unexplained: Sequence[Unexplained], gap: Gap) -> list[Unexplained]:
        """Joints that the rigid model does not explain, then the dependences at the others."""
        doubtful = self.doubtful(gap)
        joints = {entry.joint for entry in doubtful}
        return [*doubtful, *(entry for entry in unexplained if entry.joint not in joints)]


def set_up(
    training: Sequence[Experiment], validation: Sequence[Experiment], robot: RobotConfig, criteria: Criteria
) -> SetupStage:
    """Check the set-up and correct its mistakes; DataError if nothing moves or recordings do not fit together."""
    check = check_setup([*training, *validation], robot)
    shift = check.torque_shift
    training, validation = (
        outside(experiments, check.stretch, first)
        for experiments, first in ((training, 0), (validation, len(training)))
    )
    for finding in check.findings:
        if finding.kind in ("standstill", "position_step", "torque_too_small", "torque_without_sign"):
            raise DataError(f"{finding.message}; {finding.remedy}")
    corrected = robot if check.likely_robot is None else check.likely_robot
    tried = "; ".join(check.tried)
    hint = f"set-up doubtful: the rigid model leaves more than a third of this torque in every set-up tried: {tried}"
    return SetupStage(
        tuple(replace(e, dt=e.dt * check.clock) for e in with_torque_shift(training, shift)),
        tuple(replace(e, dt=e.dt * check.clock) for e in with_torque_shift(validation, shift)),
        corrected,
        tuple(f for finding in check.findings if not _remark(finding) for f in _findings(finding, check, robot)),
        tuple(
            Unexplained(joint=name, share_of_residual=1.0, varies_with="set-up", hint=hint)
            for name in check.joints_not_understood
        ),
        (
            *(f"{finding.message}: {finding.remedy}" for finding in check.findings if _remark(finding)),
            *([shift.remark] if shift is not None and shift.applied else []),
        ),
        check.relative_error_pct,
        CONVENTIONS if shift is not None and shift.undetermined else (),
        shift is not None and shift.known,
        criteria,
    )


def _remark(finding: SetupFinding) -> bool:
    """True for a limit of the recordings, and for the best of what was tried if it is more likely wrong than right."""
    return finding.kind in REMARKS or (not finding.correction and finding.probability < NAMED)


def outside(experiments: Sequence[Experiment], stretch: Sequence[Span], first: int) -> list[Experiment]:
    """Return the experiments, numbered from ``first``, without a stretch of time in which the arm is another one."""
    kept = []
    for number, e in enumerate(experiments, start=first):
        time = e.start + e.dt * np.arange(e.q.shape[0])
        inside = np.zeros(time.size, dtype=np.bool_)
        for span in stretch:
            inside |= (number == span.experiment) & (time >= span.begin) & (time <= span.end)
        edges = np.flatnonzero(np.diff(np.concatenate([[True], inside, [True]])))
        if not inside.any():
            edges = np.array([0, time.size])
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            part = slice(int(begin), int(end))
            if (end - begin) * e.dt >= MIN_PIECE_S:
                q_ref = None if e.q_ref is None else e.q_ref[part]
                start = float(time[begin])
                kept.append(replace(e, q=e.q[part], tau=e.tau[part], q_ref=q_ref, start=start))
    return kept


def _findings(finding: SetupFinding, check: SetupCheck, robot: RobotConfig) -> Iterator[Finding]:
    """A finding of the set-up with the names of the catalogue: one for each joint where signs and delays are meant."""
    names = [joint.name for joint in robot.joints]
    corrected = robot if check.likely_robot is None else check.likely_robot
    entries = corrected.effects[len(robot.effects) :]
    evidence = {
        "title": finding.kind.replace("_", " "),
        "description": finding.message,
        "remedy": finding.remedy,
        "joints": list(finding.joints),
    }

    of_joint = {(e.effect, e.joint): e.parameters for e in entries}

    def made(effect: str, joint: str, given: Mapping[str, float] | None = None, other: str | None = None) -> Finding:
        j = names.index(joint)
        values = dict(of_joint.get((effect, joint), {}) if given is None else given)
        return Finding(
            effect=effect,
            joint=joint,
            other=other,
            kind="structure",
            parameters=values,
            confidence=finding.probability,
            alternatives=[],
            gap_before=check.relative_error_pct[j],
            gap_after=(check.likely_error_pct or check.corrected_error_pct)[j],
            evidence={**evidence, "corrected": finding.kind not in WIRED or bool(values)},
        )

    worst = max(finding.joints, key=lambda name: check.relative_error_pct[names.index(name)], default="")
    if finding.kind in EACH:
        for joint in finding.joints:
            yield made(EACH[finding.kind] or finding.kind, joint)
    elif finding.kind == "joint_order":
        first, second = finding.joints[:2]
        order = [e.parameters for e in entries if e.effect == "joint_order" and e.joint in finding.joints]
        yield made("joint_order", first, order[0] if order else {}, second)
    elif finding.kind == "gravity_direction":
        yield made(finding.kind, worst, {f"gravity_{k}": g for k, g in zip("xyz", corrected.gravity, strict=True)})
    else:
        yield made(finding.kind, worst, of_joint.get(("signal_scale", worst), {}))
