"""Names of recordings, and of the topics and metadata records in them."""

import json
from collections.abc import Mapping
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
"""Metadata: schema, sample rate, checksums (`CRC_OF`) and name of the checksum records."""

SAMPLE_RATE = "sample_rate_hz"
"""Key of `RECORDING`: the sample rate, 1/s."""

ROBOT, SESSION, FACTS = "armident.robot", "armident.session", "armident.facts"
"""Metadata: the configurations as JSON, and facts about the capture."""

COUNTERS = "armident.counters"
"""Metadata: the counters of the capture, written at its end."""

CHECK = "armident.check"
"""Metadata: number of bytes before the record and their CRC-32, which at the end continues that of the head."""

CRC_OF = "crc32 "
"""Key of `RECORDING`, followed by a name of `head_texts`: its CRC-32, which other tools copy with it."""

ROWS_OF = "rows "
"""Key of `CHECK` at the end of a file, followed by a topic: the number of its messages."""

RECOVERED = "armident.recovered"
"""Metadata of a recovered file: a description of the missing parts."""


def head_texts(metadata: Mapping[str, Mapping[str, str]], layouts: Mapping[str, str]) -> dict[str, str]:
    """Return the texts in the head of a file by name, from its metadata records and the layouts (JSON) by topic."""
    texts = dict(layouts) | {SAMPLE_RATE: metadata[RECORDING].get(SAMPLE_RATE, "")}
    return texts | {
        name: json.dumps(metadata[name], sort_keys=True) for name in (ROBOT, SESSION, FACTS) if name in metadata
    }


def in_order(path: Path) -> str:
    """Key by which files sort in the order of their parts: ``NAME.mcap`` comes before ``NAME.0002.mcap``."""
    return path.name.replace(".mcap", "", 1)
