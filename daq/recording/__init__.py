"""Recordings: what they are, how they are read and written."""

from armident.daq.recording.layout import StreamLayout
from armident.daq.recording.model import Field, Gap, Mark, Recording, Stream, join_parts
from armident.daq.recording.reader import read_recording
from armident.daq.recording.recovery import Healed, heal_recording
from armident.daq.recording.ring_buffer import TriggeredSeries
from armident.daq.recording.rotation import RecordingSeries
from armident.daq.recording.writer import RecordingWriter, write_recording
from armident.daq.recording.writer_thread import QueuedSeries

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
