"""Commands of this package: identification, checks, diagnosis, use of models, history, trajectories."""

from pathlib import Path
from typing import Annotated

import typer

Json = Annotated[bool, typer.Option("--json", help="Print only the result document on stdout.")]
OutDirectory = Annotated[
    Path | None, typer.Option("--out", help="Folder for the results. [default: RECORDING without .mcap, plus a suffix]")
]
Robot = Annotated[
    Path | None, typer.Option("--config", help="Robot configuration. [default: the one inside the recording]")
]


def identify(
    recording: Annotated[Path, typer.Argument(help="Recording (.mcap).")],
    config: Robot = None,
    method: Annotated[str, typer.Option(help="idim-piv, idim-iv, idim-ls, didim, clie, cloe or sep-pem.")] = "idim-piv",
    derivatives: Annotated[
        str | None, typer.Option(help="irwsm, irwsm2 or bandpass. [default: irwsm, or the published filters]")
    ] = None,
    nvr: Annotated[
        str | None,
        typer.Option(help="Noise-variance ratio: a number, automatic, cross-validation, likelihood or tracking-error."),
    ] = None,
    controller: Annotated[
        str, typer.Option(help="crc (impulse response), parametric (cascade or PID) or known (configured).")
    ] = "crc",
    noise_model: Annotated[str, typer.Option(help="Noise model of idim-piv: black-box or grey-box.")] = "black-box",
    max_ar_order: Annotated[int, typer.Option(min=0, help="Highest order of the noise models.")] = 60,
    bandwidth: Annotated[
        float | None, typer.Option(help="Closed-loop bandwidth, Hz. [default: as configured, or estimated]")
    ] = None,
    decimation: Annotated[
        str | None,
        typer.Option(help="Decimation factor, or noise: from the memory of the noise. [default: from the bandwidth]"),
    ] = None,
    weighted: Annotated[bool, typer.Option(help="Weight each joint by its noise in idim-ls.")] = True,
    physical: Annotated[
        bool, typer.Option("--physical", help="Also compute the nearest physically consistent parameters.")
    ] = False,
    out: OutDirectory = None,
    json: Json = False,
) -> None:
    """Identify the dynamic model of a robot from a recording, and judge the result.

    Exit code 3 if the verdict is unusable: the reasons stand in the result.

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
    code = identify_command(recording, config, chosen, out, as_json=json)
    if code:
        raise typer.Exit(code)


def check(
    recordings: Annotated[list[Path], typer.Argument(help="Recordings (.mcap) of one robot at one sampling rate.")],
    config: Robot = None,
    json: Json = False,
) -> None:
    """Check the set-up in seconds: signs, order of joints, units, gear ratios, gravity, clocks, clipping, standstill.

    Prints what is wrong, how sure that is, and the line of configuration that corrects it. Exit code 0 if the set-up
    is right, 3 if results would be unusable.

    Example: armident check tx40.mcap --config configs/tx40.yaml
    """
    from armident.identify.commands import check_command

    code = check_command(recordings, config, as_json=json)
    if code:
        raise typer.Exit(code)


def worker(
    config: Annotated[Path, typer.Option("--config", help="Session configuration.")],
    once: Annotated[bool, typer.Option("--once", help="End after one experiment with its exit code.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the results. [default: the session's recording directory]")
    ] = None,
) -> None:
    """Identify every experiment of a cell when its recording ends, and publish the results.

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
        Path | None, typer.Option(help="Held-out recording. [default: the last part of the data]")
    ] = None,
    baseline: Annotated[
        Path | None, typer.Option(help="identification.json whose parameters are tested for change.")
    ] = None,
    false_alarms: Annotated[
        float, typer.Option(min=1e-6, max=0.5, help="Probability of a finding with a complete model.")
    ] = 0.01,
    material: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=100.0,
            metavar="PCT",
            help="Least change of a joint's torque by a finding, percent; smaller effects are listed as negligible.",
        ),
    ] = 0.2,
    time_limit: Annotated[
        float | None,
        typer.Option(
            min=0.0, metavar="S", help="End the search for effects after this time, s, with what it has found."
        ),
    ] = None,
    out: OutDirectory = None,
    json: Json = False,
) -> None:
    """Find the effects that a model lacks, their size and confidence, and the residual that stays unexplained.

    Exit code 4 if there are findings or an unexplained residual. `armident effects` lists the candidates.

    Example: armident diagnose monday.mcap --validate tuesday.mcap
    """
    from armident.identify.commands import diagnose_command

    chosen = {"false_alarm_rate": false_alarms, "material": material, "time_limit_s": time_limit}
    code = diagnose_command(recordings, config, validate, baseline, chosen, out, as_json=json)
    if code:
        raise typer.Exit(code)


def predict(
    recordings: Annotated[
        list[Path], typer.Argument(help="Recordings (.mcap), best ones that the model has not seen.")
    ],
    model: Annotated[Path, typer.Option("--model", help="identification.json, diagnosis.json, or the folder of one.")],
    config: Annotated[
        Path | None, typer.Option("--config", help="Robot configuration. [default: that of the model]")
    ] = None,
    out: OutDirectory = None,
    json: Json = False,
) -> None:
    """Predict the torques of recordings with an identified model, and report its error in total and by joint.

    Says if a recording is held out, or one that the model was identified from. Writes prediction.json, torques.csv and
    report.html. Of several recordings, a table shows the worst. Exit code 4 if the model explains the torques of one no
    better than none.

    Example: armident predict tuesday.mcap --model monday.identification
    """
    from armident.identify.commands import predict_command

    code = predict_command(recordings, model, config, out, as_json=json)
    if code:
        raise typer.Exit(code)


def compare(
    baseline: Annotated[Path, typer.Argument(help="The earlier identification.json, or its folder.")],
    now: Annotated[Path, typer.Argument(help="The later identification.json, or its folder.")],
    common: Annotated[
        bool, typer.Option("--common", help="Compare the parameters that both have, if their models differ.")
    ] = False,
    false_alarms: Annotated[
        float, typer.Option(min=1e-12, max=0.5, help="Probability of the verdict changed without a change.")
    ] = 1e-4,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the results. [default: comparison, beside the later one]")
    ] = None,
    json: Json = False,
) -> None:
    """Compare two identified models of a robot joint by joint, with intervals, and test for a change.

    Writes comparison.json and report.html with a plot. Exit code 4 if they differ significantly, 3 if they cannot be
    compared.

    Example: armident compare monday.identification tuesday.identification
    """
    from armident.identify.commands import compare_command

    code = compare_command(baseline, now, out, false_alarms, common=common, as_json=json)
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
        list[Path] | None, typer.Argument(help="identification.json files to add. [default: none, only list]")
    ] = None,
    database: Annotated[
        str, typer.Option(help="SQLAlchemy URL.", envvar="ARMIDENT_HISTORY")
    ] = "sqlite:///history.sqlite",
    robot: Annotated[str | None, typer.Option(help="Robot. [default: that of the results, or the only one]")] = None,
    cell: Annotated[
        str | None, typer.Option(help="Cell of the robot. [default: that of the results, or the only one]")
    ] = None,
    parameter: Annotated[list[str] | None, typer.Option(help="Parameter to show; can be repeated.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Plot parameters over time (.png, .svg, .pdf).")] = None,
    false_alarms: Annotated[
        float, typer.Option(min=1e-12, max=0.5, help="Probability of a false alarm per run.")
    ] = 1e-4,
    json: Json = False,
) -> None:
    """Keep results in a database, list them, and test for a change of the arm since the first one.

    Exit code 4 if the last run differs significantly from the first, in one parameter or in all together.

    Example: armident history recordings/*.identification/identification.json --plot history.png
    """
    from armident.identify.monitoring.history_cli import history_command

    code = history_command(documents or [], database, robot, cell, parameter or [], plot, false_alarms, as_json=json)
    if code:
        raise typer.Exit(code)


def trajectory(
    config: Annotated[Path, typer.Option("--config", help="Robot configuration.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Trajectory file to write (.yaml). [required without --look-at]")
    ] = None,
    duration: Annotated[float, typer.Option(min=1.0, help="Length, s.")] = 7.5,
    seed: Annotated[int, typer.Option(help="Seed of the random search.")] = 0,
    known: Annotated[
        Path | None,
        typer.Option(
            help="identification.json of the robot: keeps torques within limits, predicts standard deviations. "
            "[default: --masses, else masses of the URDF]"
        ),
    ] = None,
    evaluations: Annotated[int, typer.Option(min=1, help="Number of candidates to try.")] = 2000,
    wanted: Annotated[str | None, typer.Option("--for", help="Effect of the catalogue to make visible.")] = None,
    joint: Annotated[str | None, typer.Option(help="Joint of that effect. [default: all]")] = None,
    against: Annotated[str | None, typer.Option(help="Another effect to separate it from.")] = None,
    shape: Annotated[
        str, typer.Option(help="moves (point to point, trapezoidal velocities) or fourier (finite Fourier series).")
    ] = "moves",
    harmonics: Annotated[
        int | None, typer.Option(min=2, help="Number of harmonics of fourier. [default: up to 1.6 Hz, at least five]")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Plot against the limits (.png, .svg, .pdf). [default: beside --out]")
    ] = None,
    look_at: Annotated[
        Path | None,
        typer.Option(help="Check and plot an existing trajectory instead, and predict its standard deviations."),
    ] = None,
    report: Annotated[Path | None, typer.Option(help="Report (.html). [default: beside the trajectory]")] = None,
    masses: Annotated[
        Path | None,
        typer.Option(
            help="JSON file of standard parameters (m1, mx1, ...), as armident robot --truth writes it: keeps torques "
            "within limits. [default: masses of the URDF]"
        ),
    ] = None,
) -> None:
    """Design an exciting trajectory inside the limits of a robot, for the base parameters or for one effect.

    Keeps the bodies of collision in the robot configuration apart. Plots positions, velocities, accelerations and
    torques against their limits, prints the predicted standard deviation of every base parameter, and lists what was
    checked and what was not.

    Example: armident trajectory --config configs/tx40.yaml --out excitation.yaml --known identification.json
    """
    from armident.identify.documents.files import write_atomically
    from armident.identify.excitation.cli import TrajectoryOptions, trajectory_command
    from armident.identify.report.trajectory import trajectory_report

    found = trajectory_command(
        TrajectoryOptions(
            config=config,
            out=out,
            duration=duration,
            seed=seed,
            known=known,
            evaluations=evaluations,
            wanted=wanted,
            joint=joint,
            against=against,
            shape=shape,
            harmonics=harmonics,
            picture=picture,
            look_at=look_at,
            masses=masses,
        )
    )
    page = report or (found.path or Path(f"{found.robot.name}_trajectory")).with_suffix(".html")
    write_atomically(page, trajectory_report(found))
    print(f"report: {page}")
    found.refuse_excess()
