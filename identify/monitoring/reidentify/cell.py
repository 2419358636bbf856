"""Cell of a session as a way to ask an arm: it plays one trajectory on the bus, under the guard."""

from dataclasses import dataclass
from pathlib import Path

import yaml

from armident.configs import ArmidentError, ConfigError, DataError, SessionConfig, Trajectory, load_session
from armident.daq.recording import Recording, read_recording
from armident.identify.documents.files import write_atomically
from armident.identify.monitoring.reidentify.record_run import Say, record_run, start_process
from armident.processes import Start

KEEPS_ALL = {"rotate_mb": None, "rotate_minutes": None, "keep_days": None, "min_free_gb": None}
"""Options of recordings of which each motion has one file, and none is deleted."""


def load_moving_session(config: Path) -> SessionConfig:
    """Load a session that moves its arm once and records it all; ConfigError with the key if it does not."""
    session = load_session(config)
    if session.setpoints is None:
        raise ConfigError(f"{config}: setpoints: missing, so nothing would move; name an exciting trajectory")
    if session.sync.role != "producer":
        raise ConfigError(
            f"{config}: sync.role: {session.sync.role}; expected producer, which sends SYNC and can move the arm"
        )
    if session.recording.trigger is not None:
        raise ConfigError(
            f"{config}: recording.trigger: records only events; remove it, the job needs the whole motion"
        )
    return session


@dataclass(frozen=True)
class Cell:
    """The arm of a session (`load_moving_session`); motions, session and recordings are files of ``folder``."""

    session: SessionConfig
    folder: Path
    say: Say
    start: Start = start_process

    def __call__(self, trajectory: Trajectory) -> Recording:
        """Play a trajectory once under the guard, unless ``folder`` has its whole recording already."""
        file = self._file_of(trajectory)
        newest = max(self.folder.glob("*.mcap"), key=lambda path: path.stat().st_mtime_ns, default=None)
        if newest is not None and (recording := _whole(newest, file)) is not None:
            self.say(f"{newest} has this motion already")
            return recording
        assert self.session.setpoints is not None
        setpoints = self.session.setpoints.model_copy(update={"trajectory": file, "repeat": 1})
        recorded = self.session.recording.model_copy(update={**KEEPS_ALL, "directory": file.parent})
        content = self.session.model_copy(update={"setpoints": setpoints, "recording": recorded})
        config = file.parent / "session.yaml"
        write_atomically(config, yaml.safe_dump(content.model_dump(mode="json", by_alias=True, exclude_defaults=True)))
        try:
            return record_run(config, file.parent, self.say, self.start)
        except DataError as error:
            raise ArmidentError(f"{file.name}: {error}") from error

    def _file_of(self, trajectory: Trajectory) -> Path:
        """Return the file of a trajectory, which is written unless an investigation has done so."""
        content = trajectory.model_dump(mode="json", by_alias=True, exclude_defaults=True)
        text = yaml.safe_dump(content, sort_keys=False)
        known = sorted(self.folder.resolve().glob("motion_*.yaml"))
        for path in known:
            if path.read_text(encoding="utf-8") == text:
                return path
        path = self.folder.resolve() / f"motion_{len(known) + 1}.yaml"
        write_atomically(path, text)
        return path


def _whole(path: Path, trajectory: Path) -> Recording | None:
    """Return a recording if it has the motion of a trajectory file from beginning to end."""
    try:
        recording = read_recording(path)
    except DataError:
        return None
    setpoints = None if recording.session is None else recording.session.setpoints
    ends = [mark for mark in recording.marks if mark.kind == "experiment_end"]
    played = setpoints is not None and setpoints.trajectory == trajectory
    whole = bool(ends) and not ends[-1].text and recording.samples.sync[-1] >= ends[-1].sync
    return recording if played and whole and recording.missing is None else None
