"""Recordings in memory and in MCAP files: model, reader, writers and recovery."""

from armident.daq.recording.layout import StreamLayout
from armident.daq.recording.model import Field, Gap, Mark, Recording, Stream, join_parts
from armident.daq.recording.reader import is_recording, read_recording
from armident.daq.recording.recovery import Recovered, recover_recording
from armident.daq.recording.ring_buffer import TriggeredSeries
from armident.daq.recording.rotation import RecordingSeries
from armident.daq.recording.writer import RecordingWriter, write_recording
from armident.daq.recording.writer_thread import QueuedSeries

__all__ = [
    "Field",
    "Gap",
    "Mark",
    "QueuedSeries",
    "Recording",
    "RecordingSeries",
    "RecordingWriter",
    "Recovered",
    "Stream",
    "StreamLayout",
    "TriggeredSeries",
    "is_recording",
    "join_parts",
    "read_recording",
    "recover_recording",
    "write_recording",
]
