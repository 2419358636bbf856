"""Names of recordings, and of the topics and metadata records in them."""

from pathlib import Path

SCHEMA = "armident/recording/1"
"""Version of the file's content, in the metadata record ``RECORDING``."""

LIBRARY = "armident "
"""Begin of the library in the header of a file, which another tool that rewrites it replaces by its own name."""

GAPS_TOPIC, MARKS_TOPIC = "/events/gaps", "/events/marks"
"""Topics of gaps and marks, JSON."""

LAYOUT_KEY = "armident.stream"
"""Channel metadata: the layout of a stream's messages (`StreamLayout.to_json`)."""

RECORDING = "armident.recording"
"""Metadata: schema, sample rate and name of the checksum records."""

ROBOT, SESSION, FACTS = "armident.robot", "armident.session", "armident.facts"
"""Metadata: the configurations as JSON, and facts about the capture."""

COUNTERS = "armident.counters"
"""Metadata: the counters of the capture, written at its end."""

CHECK = "armident.check"
"""Metadata: number of bytes before the record and their CRC-32, which at the end continues that of the head."""

ROWS_OF = "rows "
"""Key of `CHECK` at the end of a file, followed by a topic: the number of its messages."""

RECOVERED = "armident.recovered"
"""Metadata of a recovered file: a description of the missing parts."""


def in_order(path: Path) -> str:
    """Key by which files sort in the order of their parts: ``NAME.mcap`` comes before ``NAME.0002.mcap``."""
    return path.name.replace(".mcap", "", 1)
