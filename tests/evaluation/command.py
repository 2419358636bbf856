"""Command ``python -m tests.evaluation``."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from tests.evaluation.schema import SUITE


def suite(
    suite: Annotated[Path, typer.Option("--suite", help="Suite file: effects, joints and strengths.")] = SUITE,
    out: Annotated[
        Path, typer.Option("--out", help="Folder of results and tables; a stopped run continues there.")
    ] = Path("suite"),
    quick: Annotated[bool, typer.Option("--quick", help="One arm, place, strength and run of each effect.")] = False,
    only: Annotated[
        str, typer.Option("--only", help="Effects by name, or clean, clean_baseline, pair, outside: A,B,...")
    ] = "",
    strength: Annotated[str, typer.Option("--strength", help="detectable, typical, obvious: A,B,...")] = "",
    jobs: Annotated[int | None, typer.Option("--jobs", help="Cases at a time. [default: processors]", min=1)] = None,
    minutes: Annotated[
        float | None,
        typer.Option("--minutes", help="Start no case after this time, min; call again to continue.", min=0),
    ] = None,
    any_version: Annotated[
        bool, typer.Option("--any-version", help="Use results of other versions of the code.")
    ] = False,
    list_cases: Annotated[bool, typer.Option("--list", help="Print the cases and end.")] = False,
    arms: Annotated[
        Literal["two-robots", "random"], typer.Option("--arms", help="The two virtual robots, or arms drawn at random.")
    ] = "two-robots",
    half: Annotated[
        Literal["development", "validation", "reserve"],
        typer.Option("--half", help="Set of random arms; of the reserve only totals are shown and kept."),
    ] = "development",
    cases: Annotated[
        int | None,
        typer.Option("--cases", help="First cases only. [default: all; random 88, validation and reserve 176]", min=1),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print only the result document on stdout.")] = False,
) -> None:
    """Hide effects in virtual arms, diagnose them, and print the detection rate of each effect.

    Example: python -m tests.evaluation --quick --out suite

    Random arms: python -m tests.evaluation --arms random --half development --out DIR
    """
    from tests.evaluation.run import SuiteOptions, run_suite

    def words(text: str) -> tuple[str, ...]:
        return tuple(word.strip() for word in text.split(",") if word.strip())

    options = SuiteOptions(
        out, arms, suite, half, cases, quick, words(only), words(strength), jobs, minutes, any_version
    )
    if list_cases:
        for case in options.selected():
            print(case.key, case.name)
    else:
        run_suite(options, as_json=json)
