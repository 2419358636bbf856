"""Options of the design of a trajectory."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from armident.identify.command_options import documented, option

Shape = Literal["moves", "fourier"]


@documented
@dataclass(frozen=True)
class TrajectoryOptions:
    """Options of ``armident trajectory``."""

    config: Path = option("Robot configuration.")
    out: Path | None = option("Trajectory file to write (.yaml). [required without --look-at]", None)
    duration: float = option("Length, s.", 7.5, min=1.0)
    seed: int = option("Seed of the random search.", 0)
    known: Path | None = option(
        "identification.json of the robot: keeps torques within limits, predicts standard deviations. "
        "[default: --masses, else masses of the URDF]",
        None,
    )
    evaluations: int = option("Number of candidates to try.", 2000, min=1)
    wanted: str | None = option("Effect of the catalogue to make visible.", None, flag="--for")
    joint: str | None = option("Joint of that effect. [default: all]", None)
    against: str | None = option("Another effect to separate it from.", None)
    shape: Shape = option("Point to point with trapezoidal velocities, or a finite Fourier series.", "moves")
    harmonics: int | None = option(
        "Number of harmonics of fourier. [default: up to 1.6 Hz, at least five]", None, min=2
    )
    picture: Path | None = option("Plot against the limits (.png, .svg, .pdf). [default: beside --out]", None)
    look_at: Path | None = option(
        "Check and plot an existing trajectory instead, and predict its standard deviations.", None
    )
    masses: Path | None = option(
        "JSON file of standard parameters (m1, mx1, ...), as armident robot --truth writes it: keeps torques within "
        "limits. [default: masses of the URDF]",
        None,
    )
