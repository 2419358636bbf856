"""Two published estimates of the Staubli TX40 to hold ours against."""

import csv
import re
from pathlib import Path

TABLE_B4 = {
    "zz1r": (1.24, 1.45), "fv1": (8.0, 0.91), "fc1": (7.34, 2.66), "xx2r": (-0.48, 3.28), "xz2r": (-0.16, 5.4),
    "zz2r": (1.09, 1.29), "mx2r": (2.21, 3.01), "fv2": (5.5, 1.45), "fc2": (8.24, 2.26), "xx3r": (0.13, 10.6),
    "zz3r": (0.11, 9.57), "my3r": (-0.6, 2.52), "ia3": (0.09, 9.39), "fv3": (1.93, 2.05), "fc3": (6.48, 2.06),
    "mx4": (-0.02, 35.1), "ia4": (0.03, 9.1), "fv4": (1.09, 1.62), "fc4": (2.57, 2.46), "my5r": (-0.03, 15.2),
    "ia5": (0.04, 10.6), "fv5": (1.79, 2.33), "fc5": (3.07, 3.59), "ia6": (0.01, 13.3), "fv6": (0.65, 1.85),
    "fc6": (0.3, 32.9), "fvm6": (0.61, 1.97), "fcm6": (1.9, 4.4),
}  # fmt: skip
"""Brunot 2017, table B.4: value and relative standard deviation in percent."""


def published_estimate(shared_data: Path) -> dict[str, tuple[tuple[float, float], tuple[float, float]]]:
    """By standard name: (value, relative std %) of the recording's own source, by OLS and by WLS."""
    rows = {}
    with (shared_data / "tx40" / "TX40_bp_5.csv").open() as file:
        for expression, ols, ols_pct, wls, wls_pct in csv.reader(file):
            first = re.split(r" [+-] ", expression)[0].lower().replace("fs", "fc")
            name = re.sub(r"^i([xyz][xyz]\d)", r"\1", first)
            rows[name] = ((float(ols), float(ols_pct)), (float(wls), float(wls_pct)))
    return rows
