"""What one client sees of the messages of topics: paced, newest first, bounded."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec

from rmpa.core.errors import RemoteProtocolError
from rmpa.web.monitor.live import compressed_picture, cut, field_path, number_at, raw_picture, scan
from rmpa.web.monitor.series import SampleBuffer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.web.hub.requests import ReceivedMessage
    from rmpa.web.monitor.messages import Watch

    Decode = Callable[[ReceivedMessage], Any]  # the values of a message, decoded at most once for all clients


class WatchState:
    """One watch: the newest message, or samples of its fields, until the next frame is due.

    Args:
        wanted: What the client asked for.
        decode: Gives a message's values: dicts, lists, numbers, strings; bytes for arrays of bytes.
    """

    def __init__(self, wanted: Watch, decode: Decode) -> None:
        self.wanted = wanted
        self._decode = decode
        self._newest: ReceivedMessage | None = None
        self._paths = tuple(field_path(field) for field in wanted.fields)
        self._samples = SampleBuffer(len(self._paths))
        self._sent = -1e9

    def receive(self, message: ReceivedMessage) -> None:
        """Keep a message; a plot takes its numbers at once, all others decode only what is sent.

        Raises:
            RmpaError: It cannot be decoded.
        """
        self._newest = message
        if self._paths:
            values = self._decode(message)
            self._samples.add(message.stamp_ns * 1e-9, [number_at(values, path) for path in self._paths])

    def due(self, now: float) -> float | None:
        """When the next frame may be sent; ``None`` while there is nothing to send."""
        waiting = len(self._samples) > 0 if self._paths else self._newest is not None
        return max(now, self._sent + 1 / self.wanted.rate) if waiting else None

    def frames(self, now: float) -> Iterator[str | bytes]:
        """The frame that is due.

        Raises:
            RmpaError: The message cannot be shown in that way; the text says why.
        """
        message, self._newest = self._newest, None
        self._sent = now
        if message is None and not self._paths:
            return
        head = {"id": self.wanted.id}
        if self._paths:
            yield _text({"op": "points", **head, "columns": self._samples.take()})
            return
        if message is None:
            return
        values = self._decode(message)
        about = head | {"stamp": message.stamp_ns / 1e9, "type": message.type}
        if self.wanted.how == "image":
            yield _picture(message, values).frame(self.wanted.id, message.stamp_ns)
        elif self.wanted.how == "scan":
            yield _text({"op": "scan", **about, "scan": scan(values)})
        else:
            yield _text({"op": "value", **about, "size": len(message.payload), "value": cut(values)})


def _picture(message: ReceivedMessage, values: Any) -> Any:
    try:
        if message.type == "sensor_msgs/CompressedImage":
            return compressed_picture(str(values["format"]), values["data"])
        if message.type == "sensor_msgs/Image":
            width, height, step = (int(values[name]) for name in ("width", "height", "step"))
            return raw_picture(width, height, str(values["encoding"]), step, values["data"])
    except (KeyError, TypeError, ValueError):
        pass
    raise RemoteProtocolError(f"{message.type} is not an image")


def _text(message: dict[str, Any]) -> str:
    return msgspec.json.encode(message).decode()
