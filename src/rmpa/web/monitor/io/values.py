"""The values of messages, decoded once for all pages."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.limits import KIB
from rmpa.web.monitor import limits
from rmpa.web.values.codec import codec_for

if TYPE_CHECKING:
    from rmpa.web.hub.hub import Hub
    from rmpa.web.hub.requests import Payload, ReceivedMessage


_OVERHEAD: Final = 64 * KIB
"""Bytes that an entry counts beside its payload, so that small messages do not gather."""


class MessageValues:
    """Decodes messages of the hub. Pages that watch the same topic get its message at nearly the same time.

    Args:
        hub: Knows the types.
    """

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._last: OrderedDict[int, tuple[Payload, Any]] = OrderedDict()
        self._bytes = 0

    def of(self, message: ReceivedMessage) -> Any:
        """The values of a message; they are shared, and must not be changed.

        Raises:
            RmpaError: Its type is not known, or its bytes are not a message of that type.
        """
        key = id(message.payload)
        known = self._last.get(key)
        if known is not None and known[0] is message.payload:  # an object's id is used again once it has gone
            return known[1]
        values = codec_for(self._hub.types.version(message.type, message.md5sum)).json_values(message.payload)
        if known is not None:
            self._bytes -= len(known[0]) + _OVERHEAD
        self._last[key] = message.payload, values
        self._last.move_to_end(key)
        self._bytes += len(message.payload) + _OVERHEAD
        while self._bytes > limits.VALUES_BYTES:
            _, (payload, _) = self._last.popitem(last=False)
            self._bytes -= len(payload) + _OVERHEAD
        return values
