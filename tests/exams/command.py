"""Command ``python -m tests.exams``: take an exam on public recordings."""

import os
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from tests.exams import emps, friction, kr300, tx40, ur10e

REPOSITORY = Path(__file__).resolve().parents[2]


class Exam(StrEnum):
    """Names of the exams."""

    EMPS = "emps"
    FRICTION = "friction"
    KR300 = "kr300"
    TX40 = "tx40"
    UR10E = "ur10e"


def exam(
    name: Annotated[Exam, typer.Argument(help="Exam.")],
    data: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the recordings. For emps and tx40 the parent of the folder of that name, by default "
            "$ARMIDENT_SHARED_DATA or ../shared/data; for the others a clone of the repository that the "
            "command names."
        ),
    ] = None,
) -> None:
    """Print the published figures of an exam beside ours; exit with 2 if the recordings are missing.

    Example: python -m tests.exams emps
    """
    if name in (Exam.EMPS, Exam.TX40):
        shared = Path(os.environ.get("ARMIDENT_SHARED_DATA") or REPOSITORY.parent / "shared" / "data")
        print((emps if name is Exam.EMPS else tx40).report(data or shared))
    else:
        of = {Exam.FRICTION: friction, Exam.KR300: kr300, Exam.UR10E: ur10e}
        print(of[name].report(data))
