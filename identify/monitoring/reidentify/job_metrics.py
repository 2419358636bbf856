"""Metrics of a re-identification, in a file that node_exporter serves when the job is over."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from armident.configs import ArmidentError, load_robot, load_session
from armident.configs.reasons import reason_of
from armident.identify.diagnosis.change_test import ParameterChangeTest
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.monitoring.change.comparison import joint_of, places_of
from armident.identify.monitoring.model_metrics import IDENTIFICATION, VERDICTS, identification_values, one_of
from armident.identify.monitoring.reidentify.record_run import Say
from armident.metrics import INFO, Family, Metrics, MetricsExporter, Value, check_file

JOB = Metrics(
    "reidentify",
    (
        INFO,
        Family("ended_s", "last_run_timestamp_seconds", "Time at which the last run ended."),
        Family("duration_s", "duration_seconds", "Duration of the last run, the motion included."),
        Family("exit_code", "exit_code", "Exit code: 0 unchanged, 4 changed, all others: failed."),
        Family("changed", "changed", "1 if the arm has changed since its baseline, 0 if not; absent: unknown."),
        Family("p_values", "p_value", "Probability of such a difference without a change.", ("test", "joint")),
        Family("limit", "p_value_limit", "Probability below which a test reports a change."),
        Family("investigated", "investigated", "1 if the arm was asked by further motions, otherwise 0."),
        Family("verdict", "verdict", "1 for the verdict of the identification.", ("verdict",)),
        *IDENTIFICATION,
    ),
)
"""Metrics of the last run of a job. What a failed run has not reached is absent."""


@contextmanager
def reported(path: Path | None, config: Path, say: Say) -> Iterator[dict[str, Value]]:
    """Yield the values of a job, and write them at the end of the block to a file, if any, also after an error."""
    values: dict[str, Value] = {}
    if path is None:
        yield values
        return
    check_file(path)
    session = load_session(config, "identify")
    exporter = MetricsExporter(JOB, (session.cell, load_robot(session.robot, "identify").name))
    # 130 after Ctrl-C, as the command line has it.
    began, code = time.monotonic(), 130
    try:
        yield values
        code = 0
    except Exception as error:
        code = getattr(error, "exit_code", ArmidentError.exit_code)
        raise
    finally:
        ended = {"ended_s": time.time(), "duration_s": time.monotonic() - began}
        exporter.values = {"exit_code": code, **values, **ended}
        try:
            exporter.write(path)
        except OSError as error:
            say(f"warning: no metrics: {reason_of(error)}")


def identified_values(document: IdentificationDocument) -> dict[str, Value]:
    """Return the values of the identification of a run."""
    return {"verdict": one_of(document.verdict, VERDICTS), **identification_values(document)}


def drift_values(drift: ParameterChangeTest, document: IdentificationDocument) -> dict[str, Value]:
    """Return the evidence of a change: the smallest corrected p value of each test, of the arm or of each joint."""
    places = places_of(document)
    found = [("all_parameters", "", drift.p_joint)]
    found += [
        ("one_parameter", joint_of(parameter.name, *places), float(p))
        for parameter, p in zip(drift.parameters, drift.p_values, strict=True)
    ]
    found += [(group.kind, joint_of(group.members[0], *places), group.p_value) for group in drift.groups]
    found += [("residuals", each.joint, each.p_value) for each in drift.residuals.tests]
    found += [] if drift.p_changes is None else [("catalogue", "", drift.p_changes)]
    smallest: dict[tuple[str, ...], float] = {}
    for test, joint, p in found:
        smallest[test, joint] = min(p, smallest.get((test, joint), 1.0))
    return {"p_values": smallest, "limit": drift.share}
