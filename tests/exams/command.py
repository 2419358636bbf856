"""Command ``python -m tests.exams``: take an exam on public recordings."""

import os
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from tests.exams import emps, friction, kr300

REPOSITORY = Path(__file__).resolve().parents[2]


class Exam(StrEnum):
    """Names of the exams."""

    EMPS = "emps"
    FRICTION = "friction"
    KR300 = "kr300"


def exam(
    name: Annotated[Exam, typer.Argument(help="Exam.")],
    data: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the recordings. For emps the parent of the folder emps, by default $ARMIDENT_SHARED_DATA "
            "or ../shared/data; for the others a clone of the repository that the command names."
        ),
    ] = None,
) -> None:
    """Print the published figures of an exam beside ours; exit with 2 if the recordings are missing.

    Example: python -m tests.exams emps
    """
    if name is Exam.EMPS:
        shared = Path(os.environ.get("ARMIDENT_SHARED_DATA") or REPOSITORY.parent / "shared" / "data")
        print(emps.report(data or shared))
    else:
        print((friction if name is Exam.FRICTION else kr300).report(data))
