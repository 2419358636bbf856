"""Zenoh interface: keys, blocks of samples, events and sessions."""

from armident.daq.streaming.announcer import Announcer
from armident.daq.streaming.codec import Block, assemble, decode_block, decode_event, encode_block, encode_event
from armident.daq.streaming.keys import Keys
from armident.daq.streaming.refusals import Refusals
from armident.daq.streaming.zenoh_session import open_session

__all__ = [
    "Announcer",
    "Block",
    "Keys",
    "Refusals",
    "assemble",
    "decode_block",
    "decode_event",
    "encode_block",
    "encode_event",
    "open_session",
]
