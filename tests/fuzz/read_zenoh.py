"""What comes over Zenoh: blocks of samples and events, spoiled on the way or made up."""

import json
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from armident.configs import DataError
from armident.daq.identity.folder import KeyFolder
from armident.daq.identity.signatures import Signer, Trust
from armident.daq.streaming import Block, assemble, decode_block, decode_event, encode_block, encode_event
from tests.fuzz.harness import MisreadError, Target
from tests.fuzz.mutate import either, forge_block, spoil_bytes, spoil_json, spoil_text
from tests.unit.daq.test_streaming import blocks, cell, events


@cache
def _blocks() -> list[Block]:
    return blocks(3, rows=10)


def _same(one: Block, other: Block) -> bool:
    return (
        (one.capture, one.layout, one.sequence) == (other.capture, other.layout, other.sequence)
        and np.array_equal(one.sync, other.sync)
        and np.array_equal(one.t_ns, other.t_ns)
        and all(np.array_equal(one.raw[name], values) for name, values in other.raw.items())
    )


def _check_block(data: bytes, _: Path) -> bool:
    got = decode_block(data)
    if not any(_same(got, block) for block in _blocks()):
        raise MisreadError("a block that nobody sent")
    return True


def _check_forged(data: bytes, _: Path) -> bool:
    """A block that says of itself what is not so is consistent, or refused; and so is what is made of it."""
    block = decode_block(data)
    again = decode_block(encode_block(block))
    if again.layout != block.layout or not np.array_equal(again.sync, block.sync):
        raise MisreadError("a block is not what it is encoded as")
    start, end = events(cell("fuzz"), len(_blocks()))
    assemble(start, [*_blocks(), block], end)
    return True


def _event_seeds() -> list[bytes]:
    start, end = events(cell("fuzz"), len(_blocks()))
    return [json.dumps(event).encode() for event in (start, end)] + [
        encode_event("gaps", {"capture": "c1", "gaps": [{"stream": "samples", "first": 1, "last": 2}]}),
        encode_event("mark", {"capture": "c1", "mark": "note", "sync": 3, "t_ns": 5, "text": "x"}),
    ]


def _check_event(data: bytes, _: Path) -> bool:
    """An event is understood, or refused, by itself and as start or end of a capture."""
    event = decode_event(data)
    start, end = events(cell("fuzz"), len(_blocks()))
    made = []
    for pair in ((event, end), (start, event)):
        try:
            made.append(assemble(pair[0], _blocks(), pair[1]))
        except DataError as error:
            if "\n" in str(error):
                raise AssertionError(f"an error of several lines: {error}") from error
    for recording in made:
        if not 0.0 < recording.sample_rate_hz < np.inf:
            raise MisreadError(f"a rate of {recording.sample_rate_hz}")
        for gap in recording.gaps:
            if not (isinstance(gap.first, int) and isinstance(gap.last, int) and isinstance(gap.stream, str)):
                raise MisreadError(f"a gap that is none: {gap}")
        for mark in recording.marks:
            if not (isinstance(mark.sync, int) and isinstance(mark.t_ns, int) and isinstance(mark.text, str)):
                raise MisreadError(f"a mark that is none: {mark}")
        recording.experiments()
    return bool(made)


_KEY = "armident/cell/robot/events"
_TEMPORARY = tempfile.TemporaryDirectory(prefix="armident-fuzz-")


@cache
def _folder() -> KeyFolder:
    return KeyFolder(Path(_TEMPORARY.name), local=True)


@cache
def _attachments() -> list[bytes]:
    """Attachments that may be on an event without content, and not: of another role, cell, key, and authority."""
    capture = Signer(_folder(), "capture", "cell")
    others = [Signer(_folder(), "viewer", "cell"), Signer(_folder(), "capture", "other")]
    return [
        capture.attachment(_KEY, b""),
        capture.attachment(_KEY, b"", bytes(16)),
        capture.attachment(_KEY + "x", b""),
        *(signer.attachment(_KEY, b"") for signer in others),
    ]


def _check_attachment(data: bytes, _: Path) -> bool:
    Trust(_folder(), "armident/cell/robot").check("publish", _KEY, b"", data)
    # Of a signature by ECDSA there are two forms.
    if not any(data[:-80] == right[:-80] for right in _attachments()[:2]):
        raise MisreadError("a signature that nobody made")
    return True


TARGETS = (
    Target("attachment", _attachments, spoil_bytes, _check_attachment),
    Target("block", lambda: [encode_block(b) for b in _blocks()], spoil_bytes, _check_block),
    Target("block-forged", lambda: [encode_block(b) for b in _blocks()], forge_block, _check_forged),
    Target("event", _event_seeds, either(spoil_json, spoil_json, spoil_text), _check_event),
)
