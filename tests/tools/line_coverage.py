"""Totals of a coverage report in JSON: ``python -m tests.tools.line_coverage FILE``."""

import json
import sys
from pathlib import Path


def main() -> None:
    """Print how many lines and branches were run."""
    totals = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))["totals"]
    for what, covered, every in (
        ("lines", "covered_lines", "num_statements"),
        ("branches", "covered_branches", "num_branches"),
    ):
        share = 100.0 * totals[covered] / totals[every]
        print(f"{what}: {totals[covered]} of {totals[every]} run, {share:.1f} %")


if __name__ == "__main__":
    main()
