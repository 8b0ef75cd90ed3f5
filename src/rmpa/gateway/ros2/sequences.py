"""The sequence numbers of one topic's publishers: what was lost, and what came twice. A machine without I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.gateway import limits

if TYPE_CHECKING:
    from rmpa.gateway.ros2.attachment import Ros2Attachment


class Ros2Sequences:
    """Counts gaps in the numbers that each publisher gives its messages."""

    def __init__(self) -> None:
        self._last: dict[bytes, int] = {}
        self.lost = 0
        """Messages that publishers sent and that did not come."""
        self.repeated = 0
        """Messages that came again."""

    def accept(self, attachment: Ros2Attachment, *, history: bool) -> bool:
        """Take in a message.

        Args:
            attachment: What came with it.
            history: Whether late messages may be those of a history, which came already.

        Returns:
            Whether it is new. A number that falls without a history is taken for a publisher that counts anew.
        """
        last = self._last.pop(attachment.gid, None)
        if last is None and len(self._last) >= limits.ROS2_PUBLISHERS_MAX:
            del self._last[next(iter(self._last))]
        if last is not None and history and 0 < attachment.sequence <= last:
            self._last[attachment.gid] = last
            self.repeated += 1
            return False
        self._last[attachment.gid] = attachment.sequence
        if last is not None and attachment.sequence > last + 1:
            self.lost += attachment.sequence - last - 1
        return True

    def forget(self) -> None:
        """Begin anew: what comes next was not missed."""
        self._last.clear()
