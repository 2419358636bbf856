"""Commands of this package: identify, worker, diagnose, trajectory."""

from pathlib import Path
from typing import Annotated

import typer

Json = Annotated[bool, typer.Option("--json", help="Print the result document on stdout, and nothing else there.")]
OutDirectory = Annotated[
    Path | None, typer.Option("--out", help="Folder for the results. [default: RECORDING without .mcap, plus a suffix]")
]
Robot = Annotated[
    Path | None, typer.Option("--config", help="Robot configuration. [default: the one inside the recording]")
]


def identify(
    recording: Annotated[Path, typer.Argument(help="Recording to identify from (.mcap).")],
    config: Robot = None,
    method: Annotated[str, typer.Option(help="idim-piv, idim-iv, idim-ls, didim, clie, cloe or sep-pem.")] = "idim-piv",
    derivatives: Annotated[
        str | None, typer.Option(help="irwsm, irwsm2 or bandpass. [default: irwsm, or the published filters]")
    ] = None,
    nvr: Annotated[
        str | None,
        typer.Option(help="Noise-variance ratio, or automatic, cross-validation, likelihood, tracking-error."),
    ] = None,
    controller: Annotated[
        str, typer.Option(help="crc (impulse response), parametric (cascade or PID) or known (configured).")
    ] = "crc",
    noise_model: Annotated[str, typer.Option(help="Of idim-piv: black-box or grey-box.")] = "black-box",
    max_ar_order: Annotated[int, typer.Option(min=0, help="Highest order of the noise models.")] = 60,
    bandwidth: Annotated[
        float | None, typer.Option(help="Closed-loop bandwidth, Hz. [default: configured, or from the data]")
    ] = None,
    decimation: Annotated[
        str | None,
        typer.Option(
            help="Keep one sample of so many, or noise: as many as it remembers. [default: from the bandwidth]"
        ),
    ] = None,
    weighted: Annotated[bool, typer.Option(help="Weigh each joint by its noise in idim-ls.")] = True,
    physical: Annotated[
        bool, typer.Option("--physical", help="Find the nearest physically consistent arm, too.")
    ] = False,
    out: OutDirectory = None,
    json: Json = False,
) -> None:
    """Identify the dynamic model of a robot from a recording.

    Example: armident identify tx40.mcap --out results
    """
    from armident.identify.commands import identify_command

    chosen = {
        "method": method,
        "derivatives": derivatives,
        "nvr": nvr,
        "controller": controller,
        "noise_model": noise_model,
        "max_ar_order": max_ar_order,
        "bandwidth_hz": bandwidth,
        "decimation": decimation,
        "weighted": weighted,
        "physical": physical,
    }
    identify_command(recording, config, chosen, out, as_json=json)


def worker(
    config: Annotated[Path, typer.Option("--config", help="Session configuration.")],
    once: Annotated[bool, typer.Option("--once", help="End after one experiment, with its exit code.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the results. [default: the session's recording directory]")
    ] = None,
) -> None:
    """Identify every experiment of a cell as it is recorded, and publish the results.

    Example: armident worker --config configs/tx40_cell.yaml
    """
    from armident.identify.monitoring.worker import run_worker

    code = run_worker(config, once=once, out=out)
    if code:
        raise typer.Exit(code)


def diagnose(
    recordings: Annotated[list[Path], typer.Argument(help="Recordings to fit.")],
    config: Robot = None,
    validate: Annotated[
        Path | None, typer.Option(help="Recording to judge by. [default: the last part of the data, held out]")
    ] = None,
    baseline: Annotated[
        Path | None, typer.Option(help="An identification.json whose numbers are to be judged too.")
    ] = None,
    false_alarms: Annotated[
        float, typer.Option(min=1e-6, max=0.5, help="Chance that a diagnosis of a faultless model finds something.")
    ] = 0.01,
    material: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Share of a joint's residual power worth a finding.")
    ] = 0.01,
    out: OutDirectory = None,
    json: Json = False,
) -> None:
    """Find what a model lacks: where it disagrees with the data, which effect is missing, what is left.

    Exit code 4 if something was found or stays unexplained. `armident effects` lists what it looks for.

    Example: armident diagnose monday.mcap --validate tuesday.mcap
    """
    from armident.identify.commands import diagnose_command

    chosen = {"false_alarms": false_alarms, "material": material}
    code = diagnose_command(recordings, config, validate, baseline, chosen, out, as_json=json)
    if code:
        raise typer.Exit(code)


def effects(
    name: Annotated[str | None, typer.Argument(help="One effect. [default: all]")] = None,
    json: Json = False,
) -> None:
    """List the effects that a model can have and a diagnosis looks for, with their parameters.

    Example: armident effects stribeck_friction
    """
    from armident.identify.effects.listing import effects_command

    effects_command(name, as_json=json)


def history(
    documents: Annotated[
        list[Path] | None, typer.Argument(help="Results to add: identification.json. [default: none, only list]")
    ] = None,
    database: Annotated[
        str, typer.Option(help="SQLAlchemy URL.", envvar="ARMIDENT_HISTORY")
    ] = "sqlite:///history.sqlite",
    robot: Annotated[
        str | None, typer.Option(help="Whose runs. [default: that of the results, or the only one]")
    ] = None,
    cell: Annotated[
        str | None, typer.Option(help="Where the robot stands. [default: the cell of the results, or the only one]")
    ] = None,
    parameter: Annotated[list[str] | None, typer.Option(help="Parameter to show; may be given more than once.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Plot parameters over time (.png, .svg, .pdf).")] = None,
    false_alarms: Annotated[
        float, typer.Option(min=1e-12, max=0.5, help="Chance of calling an unchanged arm changed, per run.")
    ] = 1e-4,
    json: Json = False,
) -> None:
    """Keep results in a database, list them, and say whether the arm has changed since the first of them.

    Exit code 4 if the last run differs from the first by more than chance, in one parameter or in all together.

    Example: armident history recordings/*.identification/identification.json --plot history.png
    """
    from armident.identify.monitoring.history_cli import history_command

    code = history_command(documents or [], database, robot, cell, parameter or [], plot, false_alarms, as_json=json)
    if code:
        raise typer.Exit(code)


def trajectory(
    config: Annotated[Path, typer.Option("--config", help="Robot configuration.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Trajectory file to write (.yaml). [needed without --look-at]")
    ] = None,
    duration: Annotated[float, typer.Option(min=1.0, help="Length, s.")] = 7.5,
    seed: Annotated[int, typer.Option(help="Start of the random search.")] = 0,
    known: Annotated[
        Path | None,
        typer.Option(help="An identification.json of the robot: torques stay within limits, precision is predicted."),
    ] = None,
    evaluations: Annotated[int, typer.Option(min=1, help="Candidates to try.")] = 2000,
    wanted: Annotated[
        str | None, typer.Option("--for", help="Effect of the catalogue that the trajectory is to show.")
    ] = None,
    joint: Annotated[str | None, typer.Option(help="Joint at which it is to show. [default: all]")] = None,
    against: Annotated[str | None, typer.Option(help="Another effect, from which it is to be told.")] = None,
    shape: Annotated[
        str, typer.Option(help="moves (point to point, trapezoidal velocities) or fourier (finite Fourier sums).")
    ] = "moves",
    harmonics: Annotated[
        int | None, typer.Option(min=2, help="Of fourier. [default: up to 1.6 Hz, at least five]")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Picture of it against the limits (.png, .svg, .pdf). [default: beside --out]")
    ] = None,
    look_at: Annotated[
        Path | None, typer.Option(help="Design nothing: check this trajectory, draw it, say what it will tell.")
    ] = None,
) -> None:
    """Design an exciting trajectory inside the limits of a robot, for the base parameters or for one effect.

    Before anything moves it draws positions, velocities, accelerations and torques against their limits, and prints the
    standard deviation to expect of every base parameter.

    Example: armident trajectory --config configs/tx40.yaml --out excitation.yaml --known identification.json
    """
    from armident.identify.excitation.cli import trajectory_command

    trajectory_command(
        config, out, duration, seed, known, evaluations, wanted, joint, against, shape, harmonics, picture, look_at
    )


def reproduce(
    tables: Annotated[str | None, typer.Option(help="Tables by number, as 5.2,6.7. [default: all]")] = None,
    measured: Annotated[Path | None, typer.Option(help="Folder of the measured TX40 and EMPS.")] = None,
    out: Annotated[Path, typer.Option("--out", help="Folder for the results and recordings.")] = Path("reproduction"),
    quick: Annotated[bool, typer.Option("--quick", help="Without tables 4.1 to 4.3, fewer simulations.")] = False,
    json: Json = False,
) -> None:
    """Compute the thesis's tables beside its figures, and say which of its claims hold.

    Example: armident reproduce --tables 5.2,6.7
    """
    from armident.identify.thesis.command import reproduce_command

    reproduce_command(tables, measured, out, quick, as_json=json)


def diagnose_suite(
    suite: Annotated[Path, typer.Option("--suite", help="What to hide, where and how strongly.")] = Path("suite.yaml"),
    out: Annotated[Path, typer.Option("--out", help="Directory of results and tables; a run goes on there.")] = Path(
        "suite"
    ),
    quick: Annotated[bool, typer.Option("--quick", help="One arm, place, strength and run of each effect.")] = False,
    only: Annotated[
        str, typer.Option("--only", help="Effects by name, or clean, clean_baseline, pair, outside: A,B,...")
    ] = "",
    strength: Annotated[str, typer.Option("--strength", help="detectable, typical, obvious: A,B,...")] = "",
    jobs: Annotated[int | None, typer.Option("--jobs", help="Cases at a time. [default: processors]", min=1)] = None,
    minutes: Annotated[
        float | None, typer.Option("--minutes", help="Begin no case after so long; call again to go on.", min=0)
    ] = None,
    any_version: Annotated[
        bool, typer.Option("--any-version", help="Use results that another version of the code made.")
    ] = False,
    list_cases: Annotated[bool, typer.Option("--list", help="Print the cases and end.")] = False,
    json: Json = False,
) -> None:
    """Hide effects in virtual arms, diagnose them, and say how often they are found by name.

    Results are kept case by case: a run that was stopped goes on where it was.

    Example: armident diagnose-suite --quick --out suite
    """
    from armident.identify.evaluation.run import Chosen, list_suite, run_suite

    def words(text: str) -> tuple[str, ...]:
        return tuple(word.strip() for word in text.split(",") if word.strip())

    options = Chosen(suite, out, quick, words(only), words(strength), jobs, minutes, any_version)
    if list_cases:
        list_suite(options)
    else:
        run_suite(options, as_json=json)
