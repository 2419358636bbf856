"""Check of the set-up of recordings against a configuration."""

from collections.abc import Sequence
from dataclasses import dataclass

from armident.configs import RobotConfig
from armident.daq.recording.faults.repair import repaired
from armident.identify.api.arguments import Recorded, Robot, recordings_of, robot_of
from armident.identify.api.result_base import Result
from armident.identify.api.result_tables import Table
from armident.identify.documents.base import plain, reference, versions
from armident.identify.documents.setup import SetupDocument, SetupMistake
from armident.identify.identification.from_recording import OUTSIDE, TORN, experiments_of
from armident.identify.setup.check import check_setup
from armident.identify.setup.result import SetupCheck


@dataclass(frozen=True, repr=False)
class CheckedSetup(Result):
    """Mistakes of a set-up, each with its probability and the line of configuration that corrects it, if it is certain.

    Parameters
    ----------
    document
        Everything that ``check.json`` holds.
    corrected_robot
        The configuration with the corrections that it can express; ``None`` without any.
    result
        The check with the estimated shift of the torques.
    """

    document: SetupDocument
    corrected_robot: RobotConfig | None
    result: SetupCheck
    file = "check.json"

    @property
    def passed(self) -> bool:
        """True if results would be usable: no decisive mistake, and the model explains the torque of every joint."""
        return self.document.passed

    @property
    def findings(self) -> tuple[SetupMistake, ...]:
        """Mistakes with ``kind``, ``joints``, ``probability``, ``message`` and ``remedy``; empty if there is none."""
        return tuple(self.document.findings)

    @property
    def mistakes(self) -> Table:
        """Table of the mistakes."""
        rows = [(f.kind, ", ".join(f.joints), f.probability, f.message, f.remedy) for f in self.findings]
        return Table(("kind", "joints", "probability", "message", "remedy"), rows)

    def __repr__(self) -> str:
        document, shift = self.document, self.result.torque_shift
        lines = [] if self.findings else [self._summary()]
        for finding in self.findings:
            lines.append(f"{finding.kind}: {finding.message} (probability {finding.probability:.2f})")
            lines.append(f"  {'correct it by' if finding.correction else 'next step'}: {finding.remedy}")
        lines += [f"remark: {note}" for note in document.repairs]
        if shift is not None and shift.applied:
            lines.append(f"remark: {shift.remark}")
        before, after = (
            list(errors.values())
            for errors in (document.relative_error_pct_by_joint, document.corrected_error_pct_by_joint)
        )
        if any(error != 100.0 for error in before):
            corrected = f", corrected {_listed(after)} %" if any(f.decisive for f in self.findings) else ""
            lines.append(f"torque error of the rigid model by joint: {_listed(before)} %{corrected}")
        if document.unexplained_joints:
            names = ", ".join(document.unexplained_joints)
            lines.append(f"not explained: the rigid model leaves more than a third of the torque of {names}")
            lines += [f"  tried: {'; '.join(document.tried)}"] if document.tried else []
        return "\n".join(lines)

    def _html(self) -> str:
        from armident.identify.report.setup_report import setup_report

        return setup_report(self.document, self.result)

    def _summary(self) -> str:
        if not self.findings:
            return "set-up: no mistake found"
        return f"set-up: {', '.join(dict.fromkeys(finding.kind for finding in self.findings))}"

    def _table(self) -> Table | None:
        return self.mistakes if self.findings else None


def check(recordings: Recorded | Sequence[Recorded], robot: Robot | None = None) -> CheckedSetup:
    """Check signs, order, units, gear ratios, gravity and clocks of recordings against the configuration; seconds.

    Parameters
    ----------
    recordings
        A recording, the path of one, or a sequence of them; all of one robot at one sampling rate.
    robot
        Configuration to check, or the path or shipped name of one; by default the one inside the first recording.

    Returns
    -------
    CheckedSetup
        Mistakes with their probability, and the line of configuration that corrects each, or the next step.

    Raises
    ------
    ConfigError
        If a file does not exist or a configuration is wrong.
    DataError
        If the recordings are too short, or their sampling rates differ.

    Examples
    --------
    >>> import armident
    >>> recording = armident.simulate_recording("emps", "emps_excitation", seed=1)
    >>> armident.check(recording).findings
    ()
    """
    read = recordings_of(recordings)
    config = robot_of(robot, read)
    usable = [repaired(recording) for recording in read]
    experiments, remarks = experiments_of([recording for recording, _ in usable], config, name_files=True)
    found = check_setup(experiments, config)
    joints = [joint.name for joint in config.joints]
    corrected = found.corrected_robot
    document = SetupDocument(
        robot=config.name,
        recordings=[reference(recording) for recording in read],
        passed=not found.joints_not_understood and not any(finding.decisive for finding in found.findings),
        findings=[SetupMistake(**plain(finding)) for finding in found.findings],
        relative_error_pct_by_joint=dict(zip(joints, plain(found.relative_error_pct), strict=True)),
        corrected_error_pct_by_joint=dict(zip(joints, plain(found.corrected_error_pct), strict=True)),
        unexplained_joints=list(found.joints_not_understood),
        tried=list(found.tried),
        corrected_configuration=None if corrected is None else corrected.model_dump(mode="json", by_alias=True),
        clock=float(found.clock),
        torque_shift=None if found.torque_shift is None else plain(found.torque_shift),
        repairs=[
            *(note for _, notes in usable for note in notes),
            *(note for note in remarks if OUTSIDE in note or TORN in note),
        ],
        versions=versions(),
    )
    return CheckedSetup(document, corrected, found)


def _listed(errors: "Sequence[float | None]") -> str:
    """Return errors as text, percent."""
    return ", ".join("none" if error is None else f"{error:.1f}" for error in errors)
