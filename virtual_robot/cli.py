"""Commands ``armident robot`` and ``armident demo``."""

from pathlib import Path
from typing import Annotated

import typer


def robot(
    config: Annotated[Path, typer.Option(help="Configuration of a session, or of a robot: any arm.")] = Path(
        "tx40_cell.yaml"
    ),
    scenario: Annotated[
        Path | None,
        typer.Option(help="Scenario: hidden effects, oddities of drives, controller, friction and noise."),
    ] = None,
    replay: Annotated[Path | None, typer.Option(help="Recording to replay in place of the plant.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of the noise.")] = 0,
    noise: Annotated[float, typer.Option(min=0.0, help="Factor on the noise amplitude; 0: no noise.")] = 1.0,
    model: Annotated[
        Path | None,
        typer.Option(help="Masses and friction from this identification.json, of armident identify --physical."),
    ] = None,
    arm_seed: Annotated[
        int, typer.Option(min=0, help="Seed of masses, rotors and friction that are known from nowhere.")
    ] = 0,
    draw_masses: Annotated[
        bool, typer.Option("--draw-masses", help="Draw the masses even if the URDF of the robot has some.")
    ] = False,
    write_config: Annotated[
        Path | None,
        typer.Option(help="Write robot, session and motion, with all that is assumed, to this folder for capture."),
    ] = None,
    truth: Annotated[Path | None, typer.Option(help="Write the true parameters of the arm to this JSON file.")] = None,
    duration: Annotated[
        float | None, typer.Option(min=0.0, help="Duration, s. [default: until Ctrl-C]", show_default=False)
    ] = None,
    to_file: Annotated[
        Path | None, typer.Option(help="Simulate one trajectory without a bus and write it to this recording.")
    ] = None,
    trajectory: Annotated[
        Path | None, typer.Option(help="Trajectory of --to-file. [default: that of the session's set points]")
    ] = None,
    to_command: Annotated[
        tuple[Path, Path] | None,
        typer.Option(
            help="Reference table (t, qr1 ...) to play without a bus, and the recording to write, with suffix .mcap: "
            "the program of armident investigate --robot-command."
        ),
    ] = None,
    encoder_counts: Annotated[
        int | None, typer.Option(min=1, help="Counts per motor turn, with --to-file. [default: those of the robot]")
    ] = None,
    velocity_feedback: Annotated[
        bool | None,
        typer.Option(
            "--velocity-feedback/--velocity-error",
            help="Input of the drives' velocity loop: the velocity, or the error of the velocity. [default: the error; "
            "the velocity if the robot has a known controller]",
            show_default=False,
        ),
    ] = None,
    list_effects: Annotated[
        bool, typer.Option("--list-effects", help="List the effects of scenarios with their parameters, and exit.")
    ] = False,
    list_oddities: Annotated[
        bool, typer.Option("--list-oddities", help="List the oddities of drives for scenarios, and exit.")
    ] = False,
) -> None:
    """Run a virtual robot arm on a bus: its CiA 402 drives with a simulated plant, or with a recording to replay.

    Masses are those of --model, else of the robot's URDF, else stored for the TX40 and the EMPS, else drawn.

    Example: armident robot --config tx40_cell.yaml --scenario scenarios/tx40_worn_joint2.yaml
    """
    if list_effects:
        from armident.virtual_robot.effects import describe_effects

        print(describe_effects())
        return
    if list_oddities:
        from armident.virtual_robot.oddities import describe_oddities

        print(describe_oddities())
        return

    from armident.configs import ConfigError
    from armident.virtual_robot.run import record_robot, run_robot
    from armident.virtual_robot.twin import STANDARD, ParameterChoice

    if to_command is not None:
        if to_file is not None or trajectory is not None:
            raise ConfigError("--to-command has the trajectory and the file: leave --to-file and --trajectory out")
        trajectory, to_file = to_command[0], to_command[1].with_suffix(".mcap")
    if to_file is None and (trajectory is not None or encoder_counts is not None):
        raise ConfigError("--trajectory and --encoder-counts belong to --to-file")
    if model is not None and draw_masses:
        raise ConfigError("--model has masses, and --draw-masses draws them: give only one of them")
    choice = ParameterChoice(model, arm_seed, draw_masses)
    if to_file is not None:
        if replay is not None or duration is not None or write_config is not None:
            raise ConfigError(
                "--to-file simulates one trajectory: --replay, --duration and --write-config have no meaning with it"
            )
        record_robot(
            config, to_file, scenario, seed, noise, trajectory, encoder_counts, truth, velocity_feedback, choice
        )
        return
    if scenario is not None and replay is not None:
        raise ConfigError("--scenario hides effects in the plant, and --replay has no plant: give only one of them")
    if velocity_feedback is not None and replay is not None:
        raise ConfigError("--velocity-feedback and --velocity-error choose drives, --replay has none")
    if truth is not None and replay is not None:
        raise ConfigError("--truth: a replayed recording does not know the parameters of its arm")
    if replay is not None and (choice != STANDARD or write_config is not None):
        raise ConfigError("--model, --arm-seed, --draw-masses and --write-config are of a plant, --replay has none")
    run_robot(config, scenario, replay, seed, noise, duration, truth, velocity_feedback, choice, write_config)


def demo(
    out: Annotated[Path, typer.Option("--out", help="Directory of recordings, results and the report.")] = Path("demo"),
    keep_going: Annotated[
        bool, typer.Option("--keep-going", help="Leave the virtual arm running at the end, until Ctrl-C.")
    ] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Only capture and identification, no diagnosis.")] = False,
    config: Annotated[
        Path | None,
        typer.Option(help="Configuration of a session, or of a robot. [default: the TX40]", show_default=False),
    ] = None,
    scenario: Annotated[
        Path | None,
        typer.Option(help="Scenario of the second part. [default: a worn bearing]", show_default=False),
    ] = None,
    model: Annotated[
        Path | None, typer.Option(help="Masses and friction of the arm of --config from this identification.json.")
    ] = None,
    arm_seed: Annotated[int, typer.Option(min=0, help="Seed of what is drawn, see armident robot.")] = 0,
    draw_masses: Annotated[
        bool, typer.Option("--draw-masses", help="Draw the masses even if the URDF of the robot has some.")
    ] = False,
) -> None:
    """Demonstrate capture, identification and diagnosis on this machine without hardware, and write a report.

    A virtual arm on a virtual bus is recorded and identified; then one with a hidden effect is recorded and diagnosed.

    Example: armident demo --out demo

    Example: armident demo --config my_robot.yaml --out demo
    """
    from armident.extras import require

    # Before the other imports, which need the extras.
    require("armident demo", "identify", "virtual")
    from armident.configs import ConfigError
    from armident.virtual_robot.demo import DemoOptions
    from armident.virtual_robot.demo import demo as run_demo
    from armident.virtual_robot.twin import STANDARD, ParameterChoice

    choice = ParameterChoice(model, arm_seed, draw_masses)
    if config is None and choice != STANDARD:
        raise ConfigError("--model, --arm-seed and --draw-masses are for the arm of --config")
    if model is not None and draw_masses:
        raise ConfigError("--model has masses, and --draw-masses draws them: give only one of them")
    run_demo(DemoOptions(out, keep_going, quick, config, scenario, choice))
