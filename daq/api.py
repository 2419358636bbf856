"""Recordings and captures, as ``import armident`` offers them."""

import signal
import threading
from pathlib import Path
from typing import Unpack

from armident.configs import RobotConfig, SessionConfig, load_robot, load_session
from armident.daq.interchange.import_options import ImportOptions, with_import_options
from armident.daq.interchange.readers import reader_of
from armident.daq.recording import Recording


@with_import_options()
def import_recording(
    path: str | Path, robot: RobotConfig | str | Path | None = None, **options: Unpack[ImportOptions]
) -> Recording:
    """Read measured motion and effort from a file of another format; SI units.

    Parameters
    ----------
    path
        A file or folder of one of the formats that ``armident import --help`` lists. A recording of armident is
        resampled to ``rate_hz`` with an anti-alias filter.
    robot
        The robot that was measured: a configuration, or the path or shipped name of one; for a bus log that of the
        session. Not needed for a recording of armident, which contains it.
    options
        Options of an import.

    Raises
    ------
    ConfigError
        If there is no such file, its format is unknown, or it does not take an option.
    DataError
        If its contents cannot be used; the message names the row and the column.

    Examples
    --------
    >>> import armident
    >>> recording = armident.import_recording("log.csv", "tx40", rate_hz=1000.0)  # doctest: +SKIP
    """
    from armident.configs.blanks import LOG
    from armident.daq.interchange.importing import import_recording as read

    config: RobotConfig | SessionConfig | None
    if robot is None or isinstance(robot, RobotConfig):
        config = robot
    else:
        config = load_session(robot, LOG) if reader_of(Path(path)).session else load_robot(robot, "import")
    if options.get("effort"):
        options["effort"] = Path(str(options["effort"]))
    return read(Path(path), config, **options)


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
