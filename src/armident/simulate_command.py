"""Command ``armident simulate``: the closed loop along a trajectory, of the virtual arm or of an identified model."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from armident.configs import RobotConfig


def simulate(
    trajectory: Annotated[Path, typer.Option("--trajectory", help="Trajectory file: the reference positions.")],
    out: Annotated[Path, typer.Option("--out", help="File to write: .mcap (recording) or .npz (arrays).")],
    config: Annotated[
        Path | None, typer.Option("--config", help="Robot configuration. [default: that of --model]")
    ] = None,
    model: Annotated[
        Path | None, typer.Option("--model", help="Result whose identified arm moves. [default: the virtual arm]")
    ] = None,
    physics: Annotated[
        Literal["virtual", "identified"] | None,
        typer.Option(
            "--physics",
            help="virtual (Pinocchio) or identified (equations of the identification). "
            "[default: identified with --model, else virtual]",
        ),
    ] = None,
    scenario: Annotated[
        Path | None, typer.Option("--scenario", help="Scenario: effects hidden in the virtual arm.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option("--seed", help="Seed of the noise of the virtual arm. [default: 0]")
    ] = None,
    noise: Annotated[
        float | None, typer.Option("--noise", min=0.0, help="Factor on the noise of the virtual arm. [default: 1]")
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(
            "--rate", min=1.0, help="Samples per second. [default: those of the drives, or of the model's recording]"
        ),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the result document on stdout.")] = False,
) -> None:
    """Simulate the closed loop along a trajectory, and write a recording or arrays.

    virtual: the physics are those of Pinocchio, with drives, noise and hidden effects. Masses are those of the virtual
    arm, or with --model its physically consistent ones (identify --physical).

    identified: the equations and parameters of --model, its effects included, without noise.

    Arrays are in SI units at the joints: t, q1.., tau1.., qr1.. (reference).

    Example: armident simulate --config tx40.yaml --trajectory tx40_1.yaml --out run.mcap

    Example: armident simulate --model monday.identification --trajectory tx40_1.yaml --out run.npz
    """
    from armident.configs import ConfigError, load_robot, load_trajectory
    from armident.configs.loading import load_scenario
    from armident.daq.interchange.exporting import export_recording
    from armident.daq.recording import write_recording

    if out.suffix.lower() not in (".mcap", ".npz"):
        raise ConfigError(f"--out {out}: expected a name that ends in .mcap or .npz")
    if out.exists():
        raise ConfigError(f"--out {out}: the file exists already")
    if config is None and model is None:
        raise ConfigError("--config: give the robot whose virtual arm moves, or --model")
    reference = load_trajectory(trajectory)
    identified = physics == "identified" or (physics is None and model is not None)
    if identified:
        from armident.identify.identification.saved_model import load_model
        from armident.identify.identification.simulated_recording import simulate_model

        if model is None:
            raise ConfigError("--physics identified: give the identified arm by --model")
        if scenario is not None or seed is not None or noise is not None:
            raise ConfigError("--scenario, --seed and --noise belong to --physics virtual")
        robot = None if config is None else load_robot(config, "identify")
        recording = simulate_model(load_model(model, robot), reference, rate)
    else:
        from armident.virtual_robot.api import simulate_recording

        hidden = None if scenario is None else load_scenario(scenario)
        if hidden is not None and hidden.drives:
            raise ConfigError(f"{scenario}: drives: a simulation has no bus, on which drives could be odd")
        result = None if model is None else model / "identification.json" if model.is_dir() else model
        recording = simulate_recording(
            config or _robot_of(result),
            reference,
            scenario=hidden,
            seed=seed or 0,
            noise=1.0 if noise is None else noise,
            period=None if rate is None else 1.0 / rate,
            model=result,
        )
    if out.suffix.lower() == ".mcap":
        write_recording(recording, out)
    else:
        export_recording(recording, out)
    if not json:
        print(out)
        return
    from armident.identify.documents.base import reference as reference_to
    from armident.identify.documents.files import to_json
    from armident.identify.documents.simulation import SimulationDocument

    document = SimulationDocument(
        robot=recording.robot.name,
        physics="identified" if identified else "virtual",
        trajectory=str(trajectory),
        model=None if model is None else str(model),
        scenario=None if scenario is None else str(scenario),
        seed=None if identified else seed or 0,
        noise=None if identified else 1.0 if noise is None else noise,
        recording=reference_to(recording).model_copy(update={"path": str(out)}),
        duration_s=float(recording.samples.sync[-1] - recording.samples.sync[0]) / recording.sample_rate_hz,
    )
    print(to_json(document), end="")


def _robot_of(document: Path | None) -> "RobotConfig":
    from armident.identify.identification.saved_model import load_model

    assert document is not None
    return load_model(document).robot
