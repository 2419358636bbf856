"""Recordings: what they are, how they are read and written."""

from daq.recording.healing import Healed, heal_recording
from daq.recording.layout import StreamLayout
from daq.recording.model import Field, Gap, Mark, Recording, Stream, join_parts
from daq.recording.queued import QueuedSeries
from daq.recording.reader import read_recording
from daq.recording.series import RecordingSeries
from daq.recording.triggered import TriggeredSeries
from daq.recording.writer import RecordingWriter, write_recording

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
