"""Diagnosis of the effects that a model lacks, and the effects that it looks for."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

from armident.configs import ConfigError, DataError, RobotConfig
from armident.identify.api.arguments import Progress, Recorded, Robot, recordings_of, robot_of
from armident.identify.api.identification_api import Identification, identified
from armident.identify.api.result_base import Result
from armident.identify.api.result_tables import EffectTable, Table
from armident.identify.documents.base import reference
from armident.identify.documents.diagnosis import DiagnosisDocument
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.effects.registry import catalogue
from armident.identify.identification.from_recording import experiments_of, rest_notes
from armident.identify.report.robot_file import robot_yaml
from armident.identify.signals.experiments import Experiment

if TYPE_CHECKING:
    from armident.identify.diagnosis.diagnose import DiagnosisResult


@dataclass(frozen=True, repr=False)
class Diagnosis(Result):
    """Disagreement of a model with recordings, and the effects that explain it.

    Parameters
    ----------
    document
        Everything that ``diagnosis.json`` holds.
    robot
        The configuration with the effects found added to it; `identify` and `simulate_recording` accept it.
    configured
        The configuration that was judged.
    result
        The findings with their curves.
    """

    document: DiagnosisDocument
    robot: RobotConfig
    configured: RobotConfig
    result: "DiagnosisResult"
    file = "diagnosis.json"

    @property
    def verdict(self) -> str:
        """``no_gap``, ``explained``, ``partly_explained`` or ``unexplained``."""
        return self.document.verdict

    @property
    def findings(self) -> Table:
        """Table of the effects found, in the order found; gaps are torque errors in percent on held-out data."""
        rows = [
            (
                finding.effect,
                finding.joint if finding.other is None else f"{finding.joint}, {finding.other}",
                ", ".join(f"{name} {value:.4g}" for name, value in finding.parameters.items()),
                finding.confidence,
                finding.gap_before,
                finding.gap_after,
            )
            for finding in self.document.findings
        ]
        columns = ("effect", "joint", "parameters", "confidence", "gap_before", "gap_after")
        return Table(columns, rows, f"{self.document.robot}: {self.verdict}")

    @property
    def gap_pct(self) -> tuple[float, float]:
        """Torque error on held-out data of the model as configured, and with the findings, percent."""
        gap = self.document.gap.validation
        return gap.before.all, gap.after.all

    def _for_folder(self, folder: Path) -> tuple[Self, dict[Path, str]]:
        if self.robot == self.configured or self.document.model is not None:
            return self, {}
        model = folder / "model.yaml"
        document = self.document.model_copy(update={"model": str(model)})
        return replace(self, document=document), {model: robot_yaml(self.robot)}

    def _html(self) -> str:
        from armident.identify.report.diagnosis_report import diagnosis_report

        return diagnosis_report(self.result, self.document)

    def _table(self) -> Table | None:
        return self.findings if self.document.findings else None

    def _summary(self) -> str:
        before, after = self.gap_pct
        return (
            f"{self.document.robot}: {self.verdict}; torque error on held-out data {before:.2f} % before, "
            f"{after:.2f} % after"
        )


def diagnose(
    recordings: Recorded | Sequence[Recorded],
    robot: Robot | None = None,
    *,
    validate: Recorded | None = None,
    baseline: Identification | IdentificationDocument | str | Path | None = None,
    false_alarm_rate: float = 0.01,
    material: float = 0.2,
    time_limit_s: float | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Find the effects that a model lacks: where it disagrees with the data, which effect is missing, what is left.

    Parameters
    ----------
    recordings
        A recording, the path of one, or a sequence of them; the models are fitted to these.
    robot
        Configuration in question, or the path or shipped name of one; by default the one inside the first recording.
    validate
        A recording to judge by; by default the last part of the data is held out.
    baseline
        An identification of the healthy robot; changes of its parameters are judged too.
    false_alarm_rate
        Probability that a diagnosis of a faultless model finds something.
    material
        Least change of a joint's torque by a finding, percent of the root mean square of its torque; effects that
        change less are listed as ``negligible``.
    time_limit_s
        Wall-clock time after which the selection of effects ends with what it has found, s, greater than 0;
        ``None``: without limit. Confirmation and report of these effects take further seconds.
    progress
        Called with the name of a stage and the share done, 0 to 1.

    Returns
    -------
    Diagnosis
        Verdict, findings, gaps before and after, and the configuration with the findings added.

    Raises
    ------
    ConfigError
        If a file does not exist, a configuration is wrong, or the time limit is not greater than 0.
    DataError
        If the recordings cannot support a diagnosis, or the baseline is of another robot.

    Examples
    --------
    >>> import armident
    >>> worn = armident.simulate_recording("tx40", "tx40_excitation", scenario="tx40_worn_joint2", seed=1)
    >>> found = armident.diagnose(worn)
    >>> found.findings[0]["effect"], found.findings[0]["joint"]
    ('asymmetric_viscous_friction', 'joint_2')
    """
    from armident.identify.diagnosis.criteria import Criteria
    from armident.identify.diagnosis.diagnose import run_diagnosis

    if time_limit_s is not None and not time_limit_s > 0:
        raise ConfigError(f"--time-limit: expected a time greater than 0 s, found {time_limit_s:g}")
    begin = time.monotonic()
    read = recordings_of(recordings)
    config = robot_of(robot, read)
    numbers = None if baseline is None else identified(baseline)[0]
    if numbers is not None and numbers.robot != config.name:
        name = baseline if isinstance(baseline, str | Path) else "baseline"
        raise DataError(f"{name}: the baseline is of robot {numbers.robot!r}, the recording of {config.name!r}")
    training, notes = experiments_of(read, config, name_files=True)
    held_out: Sequence[Experiment] = []
    if validate is not None:
        read = (*read, *recordings_of(validate))
        held_out, more = experiments_of(read[-1:], config, name_files=True)
        notes += more
    notes += rest_notes(training, config)
    criteria = Criteria(false_alarm_rate=false_alarm_rate, material_pct=material)
    references = [reference(recording) for recording in read]
    found = run_diagnosis(
        training,
        held_out,
        config,
        references,
        numbers,
        list(dict.fromkeys(notes)),
        progress,
        criteria,
        None if time_limit_s is None else time_limit_s - (time.monotonic() - begin),
    )
    return Diagnosis(found.document, found.robot, config, found)


def effects() -> EffectTable:
    """Return the effects that a model can have and a diagnosis looks for.

    Effects of other packages (entry points of group ``armident.effects``) are among them.

    Raises
    ------
    ConfigError
        If the entry point of another package cannot be loaded.

    Examples
    --------
    >>> import armident
    >>> armident.effects()["stribeck_friction"].scope
    'joint'
    """
    return EffectTable(catalogue())
