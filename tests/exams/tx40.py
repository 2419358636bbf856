"""Staubli TX40: base parameters of a measured arm beside two published estimates.

One estimate is of the same recording, by those who published it; the other (thesis, table B.4) of another arm of this
type. Neither controller nor reference was recorded.
"""

from pathlib import Path

import armident
from armident.configs import ConfigError
from armident.configs.yaml_loader import is_file
from armident.identify.identification.options import Options
from armident.identify.identification.pipeline import identify_experiment
from tests.reproduction.recordings import measured_recording
from tests.tools.markdown import table
from tests.tx40_reference import TABLE_B4, published_estimate

FILES = ("pos_read_data.csv", "curr_data.csv", "TX40_bp_5.csv")
WHERE = (
    "get it from examples/staubli_TX40 of github.com/thanhndv212/figaroh-examples, put it into FOLDER/tx40 and repeat "
    "with --data FOLDER"
)
SURE_PCT = 10.0
"""Relative standard deviation of a published value, percent, from which on it is not held against ours."""


def report(folder: Path) -> str:
    """Return the table of the exam. Raises ConfigError if a file is missing."""
    for file in (folder / "tx40" / name for name in FILES):
        if not is_file(file):
            raise ConfigError(f"{file} is missing: {WHERE}")
    found = identify_experiment(measured_recording(folder).experiment, armident.load_robot("tx40"), Options())
    ours = dict(zip(found.names, zip(found.theta, found.std, strict=True), strict=True))
    source = {(name if name in ours else f"{name}r"): ols for name, (ols, _) in published_estimate(folder).items()}
    rows, agree, sure = [], 0, 0
    for name, (value, std) in ours.items():
        row = [name, f"{value:.3f} ± {std:.3f}"]
        for published in (source, TABLE_B4):
            theirs, percent = published.get(name, (0.0, 100.0))
            if percent >= SURE_PCT:
                row.append("")
                continue
            distance = abs(value - theirs) / (abs(theirs) * percent / 100)
            row.append(f"{theirs:.3f} ({distance:.1f})")
            sure, agree = sure + 1, agree + (distance <= 3)
        if any(row[2:]):
            rows.append(row)
    return "\n\n".join([
        table(("parameter", "ours", "the same recording (distance in its std)", "table B.4 (distance)"), rows),
        f"{agree} of {sure} published values agree within three of their standard deviations; "
        f"relative error {found.relative_error_pct:.2f} %, {found.method}",
    ])  # fmt: skip
