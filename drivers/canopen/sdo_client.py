"""SDO client of the canopen library that matches answers to requests (CiA 301, SDO protocols)."""

import queue
import time
from typing import Any

import canopen
from canopen.sdo import SdoAbortedError, SdoClient, SdoCommunicationError

_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = range(5)
"""Command specifiers of requests and, for ``_ABORT``, of answers (CiA 301, SDO protocols)."""
_ANSWER_TO = {_DOWNLOAD_SEGMENT: 1, _DOWNLOAD: 3, _UPLOAD: 2, _UPLOAD_SEGMENT: 0}
"""Command specifier of the answer to each request."""
_TOGGLE = 0x10
_TIMED_OUT = 0x05040000


class OtherAnswersError(SdoCommunicationError):
    """All answers of a drive in the time for an answer belong to other requests."""


class MatchingSdoClient(SdoClient):
    """SDO client that takes only the answer to its request: by command, and by index and sub-index or toggle bit.

    On the default SDO channel, answers to other clients of the drive arrive too, and some drives repeat theirs.
    """

    def __init__(self, rx_cobid: int, tx_cobid: int, od: Any) -> None:
        super().__init__(rx_cobid, tx_cobid, od)
        self._object = bytes(3)

    def request_response(self, sdo_request: bytes) -> bytes:
        """Send the eight bytes of a request and return its answer; OtherAnswersError if only other answers came."""
        if sdo_request[0] >> 5 in (_DOWNLOAD, _UPLOAD):
            self._object = bytes(sdo_request[1:4])
        self.responses: queue.Queue[bytes] = queue.Queue()
        self.send_request(sdo_request)
        until, others = time.monotonic() + self.RESPONSE_TIMEOUT, 0
        while (left := until - time.monotonic()) > 0:
            try:
                answer = self.responses.get(timeout=left)
            except queue.Empty:
                break
            if self._belongs(answer, sdo_request):
                if answer[0] >> 5 == _ABORT:
                    raise SdoAbortedError(int.from_bytes(answer[4:8], "little"))
                return answer
            others += 1
        self.abort(_TIMED_OUT)
        if others:
            raise OtherAnswersError(f"{others} answers to other requests")
        raise SdoCommunicationError("no answer")

    def _belongs(self, answer: bytes, request: bytes) -> bool:
        """Return True if an answer belongs to a request of the present transfer."""
        kind = request[0] >> 5
        if not answer or answer[0] >> 5 not in (_ANSWER_TO[kind], _ABORT):
            return False
        if answer[0] >> 5 == _ABORT or kind in (_DOWNLOAD, _UPLOAD):
            # Some drives do not name the object of an abort.
            named = answer[1:4] if answer[0] >> 5 != _ABORT or any(answer[1:4]) else self._object
            return named == self._object
        return answer[0] & _TOGGLE == request[0] & _TOGGLE


class SdoNode(canopen.RemoteNode):
    """Remote node whose SDO client matches answers to requests."""

    def add_sdo(self, rx_cobid: int, tx_cobid: int) -> MatchingSdoClient:
        """Add an SDO channel. ``rx_cobid``, ``tx_cobid``: identifiers of requests and of answers."""
        client = MatchingSdoClient(rx_cobid, tx_cobid, self.object_dictionary)
        self.sdo_channels.append(client)
        return client
