"""Recordings: what they are, how they are read and written."""

from armident.daq.recording.healing import Healed, heal_recording
from armident.daq.recording.layout import StreamLayout
from armident.daq.recording.model import Field, Gap, Mark, Recording, Stream, join_parts
from armident.daq.recording.queued import QueuedSeries
from armident.daq.recording.reader import read_recording
from armident.daq.recording.series import RecordingSeries
from armident.daq.recording.triggered import TriggeredSeries
from armident.daq.recording.writer import RecordingWriter, write_recording

__all__ = [
    "Field",
    "Gap",
    "Healed",
    "Mark",
    "QueuedSeries",
    "Recording",
    "RecordingSeries",
    "RecordingWriter",
    "Stream",
    "StreamLayout",
    "TriggeredSeries",
    "heal_recording",
    "join_parts",
    "read_recording",
    "write_recording",
]
