"""Folder of an arm that is asked: its motions, their recordings, and what a kill leaves of them."""

from collections.abc import Callable
from pathlib import Path

import yaml

from armident.configs import DataError, Trajectory
from armident.daq.recording import Recording, read_recording
from armident.daq.recording.writer import write_recording
from armident.identify.documents.base import RecordingReference
from armident.identify.documents.files import write_atomically

Ask = Callable[[Trajectory], Recording]
"""Plays a trajectory on the robot and returns the recording; DataError if it refuses to, MotionStopped ends all."""
Progress = Callable[[str, float], None]


def keep_motion(folder: Path, number: int, trajectory: Trajectory) -> str:
    """Write a motion, and return the name of its file."""
    content = trajectory.model_dump(mode="json", by_alias=True, exclude_defaults=True)
    write_atomically(folder / f"motion_{number}.yaml", yaml.safe_dump(content, sort_keys=False))
    return f"motion_{number}.yaml"


def answer_of(folder: Path | None, number: int, trajectory: Trajectory, ask: Ask) -> Recording:
    """Return the recording of a motion, which the folder keeps. Raises what ``ask`` raises."""
    if folder is None:
        return ask(trajectory)
    kept = folder / f"motion_{number}.mcap"
    # A process that was killed may have written the recording and not entered it.
    recording = read_recording(kept) if kept.exists() else ask(trajectory)
    if recording.path is None or recording.path.resolve().parent != folder.resolve():
        write_recording(recording, kept)
        recording = read_recording(kept)
    return recording


def read_again(expected: RecordingReference) -> Recording:
    """Read a recording of a document. Raises DataError if it changed since."""
    recording = read_recording(Path(str(expected.path)))
    if recording.sha256 != expected.sha256:
        raise DataError(f"{expected.path}: is not the recording that the investigation used; restore it")
    return recording
