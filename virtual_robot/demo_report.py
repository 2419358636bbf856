"""Report and tables of ``armident demo``."""

import os
import re
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template
from typing import Any

from armident.configs import ArmidentError, ConfigError, RobotConfig
from armident.configs.expression import evaluate

_PART = re.compile(r"<!-- chapter begins -->(.*?)<!-- chapter ends -->", re.DOTALL)


@dataclass(frozen=True)
class Identified:
    """Results of the first part; ``truth``: known true values by name; ``lost``: number of lost samples."""

    document: dict[str, Any]
    report: Path
    truth: dict[str, float]
    lost: int


@dataclass(frozen=True)
class Investigated:
    """Results of the second part: contents of two documents, and the effects that were ``hidden``, with joints."""

    document: dict[str, Any]
    diagnosis: dict[str, Any]
    report: Path
    hidden: tuple[str, ...]


def true_values(document: Mapping[str, Any], truth: Mapping[str, float], robot: RobotConfig) -> dict[str, float]:
    """True values of identified parameters: of the arm, or of the formula (of ``d1``, ...) of a regrouped one."""
    names = dict(truth)
    for j, joint in enumerate(robot.joints, start=1):
        names |= {f"d{j}": joint.mdh.d, f"r{j}": joint.mdh.r}
    out = {}
    for parameter in document["parameters"]:
        name, formula = parameter["name"], parameter.get("formula")
        if name in truth:
            out[name] = truth[name]
        elif formula:
            try:
                out[name] = evaluate(formula.replace("^", "**"), names)
            except ConfigError:
                continue  # a parameter that the arm does not have
    return out


def write_report(out: Path, robot: RobotConfig, first: Identified, second: Investigated | None) -> Path:
    """Join the reports of both parts to one page ``report.html``; ``None``: the second was left out."""
    page = first.report.read_text(encoding="utf-8")
    parts = [_part(page)] + ([] if second is None else [_part(second.report.read_text(encoding="utf-8"))])
    head = page[: page.index("<!-- chapter begins -->")]
    tail = page[page.index("<!-- chapter ends -->") :].removeprefix("<!-- chapter ends -->")
    path = out / "report.html"
    handle, temporary = tempfile.mkstemp(dir=out, prefix=".report.")
    with os.fdopen(handle, "w", encoding="utf-8") as file:
        file.write(head + _SUMMARY.substitute(_summary(robot, first, second)))
        file.write("".join(f'<section style="margin-top:56px">{part}</section>' for part in parts) + tail)
    os.chmod(temporary, 0o644)
    os.replace(temporary, path)
    return path


def _part(page: str) -> str:
    found = _PART.search(page)
    if found is None:
        raise ArmidentError("demo: a report has no section between the marks of its beginning and end")
    return found.group(1)


_SUMMARY = Template("""
<h1>armident: results of the demo</h1>
<p class="sub">The arm ($robot), its drives and its bus are virtual; all other processes are those of a real cell.</p>
<ol>
<li>The drives were configured over CANopen and recorded at $rate samples per second: $rows samples of each of
$joints joints, $gaps lost.</li>
<li>A worker received the samples on Zenoh and identified the dynamic model. It has $essential essential parameters and
predicts the torques with a relative error of $error %. Of $compared parameters with a known true value, $close lie
within three standard deviations of it (largest deviation: $worst).</li>
$second
</ol>
""")


def _summary(robot: RobotConfig, first: Identified, second: Investigated | None) -> dict[str, str]:
    document = first.document
    compared = _against_truth(first)
    worst = max(compared, key=lambda row: abs(row[4]), default=None)
    line = ""
    if second is not None:
        gap = second.diagnosis["gap"]["validation"]
        asked = " ".join(
            f"The recording left a question: {one['question']} The arm was asked for a motion of "
            f"{one['chosen']['duration_s']:.1f} s: {one['chosen']['words']}."
            for one in second.document["rounds"]
        )
        line = (
            f"<li>Then {escape(', '.join(second.hidden)) or 'nothing'} was hidden in the arm, unknown to the "
            f"investigation. {escape(asked) or 'The recording was enough.'} The result: "
            f"<b>{escape(second.document['statement'])}</b> On held-out data the relative torque error decreased from "
            f"{gap['before']['all']:.2f} % to {gap['after']['all']:.2f} %; "
            f"the noise floor is {second.diagnosis['noise_floor']['all']:.2f} %.</li>"
        )
    counters = {} if worst is None else {"worst": f"{worst[0]}, {abs(worst[4]):.1f}"}
    return {
        "robot": escape(robot.description or robot.name),
        "rate": f"{document['recording']['sample_rate_hz']:.0f}",
        "rows": str(document["recording"]["samples"]),
        "joints": str(len(document["relative_error_pct_by_joint"])),
        "gaps": str(first.lost or "none"),
        "essential": str(sum(1 for p in document["parameters"] if p["essential"])),
        "error": f"{document['relative_error_pct']:.1f}",
        "close": str(sum(1 for row in compared if abs(row[4]) <= 3)),
        "compared": str(len(compared)),
        "worst": "none",
        "second": line,
        **counters,
    }


def _against_truth(first: Identified) -> list[tuple[str, float, float, float, float]]:
    """Essential parameters: name, value, standard deviation, true value, and deviation in standard deviations."""
    return [
        (p["name"], p["value"], p["std"], first.truth[p["name"]], (p["value"] - first.truth[p["name"]]) / p["std"])
        for p in first.document["parameters"]
        if p["essential"] and p["name"] in first.truth and p["std"] > 0
    ]


def print_results(first: Identified, second: Investigated | None) -> None:
    """Print the identified parameters beside the true ones, and the findings of the second part, if any."""
    print(f"\n{'parameter':>10} {'identified':>11} {'+- std':>9} {'true':>9} {'off by':>9}")
    for name, value, std, truth, distance in _against_truth(first):
        print(f"{name:>10} {value:11.4f} {std:9.4f} {truth:9.4f} {distance:5.1f} std")
    if second is not None:
        gap = second.diagnosis["gap"]["validation"]
        print(f"\nhidden: {', '.join(second.hidden) or 'nothing'}")
        for asked in second.document["rounds"]:
            print(f"question: {asked['question']}\n  {asked['chosen']['words']}, {asked['chosen']['duration_s']:.1f} s")
        print(f"answer: {second.document['outcome'].replace('_', ' ')}. {second.document['statement']}")
        for f in second.diagnosis["findings"]:
            print(
                f"  {f['effect']} in {f['joint']}: {f['gap_before']:.2f} % -> {f['gap_after']:.2f} % on held-out data"
            )
        print(f"  all joints: {gap['before']['all']:.2f} % -> {gap['after']['all']:.2f} %")


def print_next_steps(report: Path) -> None:
    """Print the path of the report and the commands for a user's own robot."""
    print(
        "\nnext, with measurements of your own robot (or on its bus: armident capture --config CELL.yaml):\n"
        "  armident import DATA.csv --config ROBOT.yaml --out my_robot.mcap\n"
        "  armident identify my_robot.mcap --out results\n"
        f"report: {report}",
        flush=True,
    )
