"""A call of a client of ROS 2 that comes by rclpy, to be answered as one that comes by Zenoh."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final

from rmpa.gateway.ros2.format import Ros2Attachment

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.runtime.tls import Buffer

# The number of a call in frames between the gateway and ROS 2's half.
CALL: Final = struct.Struct("<Q")


class RclpyQuery:
    """A call of a ROS 2 client, to be answered once.

    Args:
        answer: Sends the call's number, whether it succeeded (1 byte), and the response as CDR.
        call: The call's number.
        key: The service's.
        request: As CDR.
    """

    def __init__(self, answer: Callable[[bytes], object], call: bytes, key: str, request: bytes) -> None:
        self._answer = answer
        self._call: bytes | None = call
        self.key = key
        self.parameters = ""
        self.payload = request
        self.attachment = Ros2Attachment(CALL.unpack(call)[0], 0, bytes(16)).serialize()

    def reply(self, _key: str, payload: Buffer, _attachment: bytes = b"") -> None:
        """Give the answer."""
        self._finish(b"\1", bytes(payload))

    def reply_error(self, _text: str) -> None:
        """Give up: ROS 2 has no response that says that a call has failed, and its client goes on waiting."""
        self._finish(b"\0", b"")

    def finish(self) -> None:
        """No answer follows."""
        self._finish(b"\0", b"")

    def _finish(self, succeeded: bytes, payload: bytes) -> None:
        call, self._call = self._call, None
        if call is not None:
            self._answer(call + succeeded + payload)
