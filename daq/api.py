"""Recordings and captures, as ``import armident`` offers them."""

import signal
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

from armident.configs import RobotConfig, load_robot
from armident.daq.recording import Recording


def import_recording(
    path: str | Path,
    robot: RobotConfig | str | Path | None = None,
    *,
    effort: str | Path | None = None,
    motor_side: bool = False,
    rate_hz: float | None = None,
    names: Mapping[str, str] | None = None,
    polled: bool = False,
    resample_hz: float | None = None,
    time_unit: str | None = None,
    topic: str | None = None,
    joints: Sequence[str] | None = None,
    by_position: bool = False,
    units: Mapping[str, str] | None = None,
) -> Recording:
    """Read measured motion and effort from a file of another format; SI units.

    Parameters
    ----------
    path
        CSV with a header line (``t``, ``q1..qn``, ``tau1..taun`` or ``current1..currentn``, optionally ``qr1..qrn``),
        MAT (up to version 7), NPZ, Parquet, or joint states in a bag of ROS 2 (MCAP, SQLite, or its folder). A
        recording of armident is resampled to ``rate_hz`` with an anti-alias filter.
    robot
        The robot that was measured: a configuration, or the path or shipped name of one; needed except for a
        recording of armident, which contains it.
    effort
        A second CSV with one effort column per joint; ``path`` then has one position column per joint.
    motor_side
        True if positions and torques are those of the motors; currents and voltages always are.
    rate_hz
        Sampling rate, Hz; needed where the file has no time column.
    names
        Names in this file by quantity (``time``, ``position``, ``torque``, ``current``, ``voltage``, ``demand``);
        ``-`` leaves a quantity out.
    polled
        True if samples were polled, so that their times jitter: they are put on an even clock.
    resample_hz
        Rate of an even clock, Hz, for samples with uneven times, or polled ones; holes stay gaps.
    time_unit
        Unit of the times: ``s``, ``ms``, ``us`` or ``ns``; seconds by default.
    topic
        Topic of joint states, if a bag has several with the robot's joints.
    joints
        Names in a bag of the robot's joints, in the robot's order; by default those of the robot.
    by_position
        True to take joints of other names in the order of the bag.
    units
        Units other than SI by quantity: ``position`` in ``deg``, ``mm`` or ``deg|mm``; ``torque`` in ``mnm``.

    Raises
    ------
    ConfigError
        If there is no such file or its format is unknown.
    DataError
        If its contents cannot be used; the message names the row and the column.

    Examples
    --------
    >>> import armident
    >>> recording = armident.import_recording("log.csv", "tx40", rate_hz=1000.0)  # doctest: +SKIP
    """
    from armident.daq.interchange.importing import import_recording as read

    config = robot if robot is None or isinstance(robot, RobotConfig) else load_robot(robot, "import")
    second = None if effort is None else Path(effort)
    return read(
        Path(path),
        config,
        effort=second,
        motor_side=motor_side,
        rate_hz=rate_hz,
        resample_hz=resample_hz,
        time_unit=time_unit,
        names=names,
        polled=polled,
        topic=topic,
        joints=joints,
        by_position=by_position,
        units=units,
    )


def capture(
    session: str | Path,
    *,
    out: str | Path | None = None,
    duration: float | None = None,
    listen_only: bool = False,
) -> tuple[Path, ...]:
    """Capture a session to MCAP files; blocks until the end.

    Ctrl-C (in the main thread) and the end of the trajectory or of ``duration`` finish the files.

    Parameters
    ----------
    session
        Path or shipped name of a session configuration.
    out
        Folder of the recordings; by default that of the session.
    duration
        Seconds to capture; by default until the trajectory has been played, or until Ctrl-C without one.
    listen_only
        True to send nothing on the bus.

    Returns
    -------
    tuple of Path
        The finished recordings, in order.

    Raises
    ------
    ConfigError
        If the capture cannot start: configuration, bus, drives, disk.
    ArmidentError
        If bus or drives failed during the capture; the recordings are finished then too.
    """
    from armident.daq.capture.capture import capture as run
    from armident.daq.capture.plan import load_plan

    plan = load_plan(str(session), None if out is None else Path(out), duration, listen_only)
    stop = threading.Event()
    in_main_thread = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, lambda *_: stop.set()) if in_main_thread else None
    try:
        captured = run(plan, stop)
    finally:
        if in_main_thread:
            signal.signal(signal.SIGINT, before)
    if captured.failure is not None:
        raise captured.failure
    return captured.paths
