"""Recordings: what they are, how they are read and written."""

from daq.recording.model import Field, Gap, Mark, Recording, Stream

__all__ = ["Field", "Gap", "Mark", "Recording", "Stream"]
