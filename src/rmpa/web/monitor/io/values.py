"""The values of messages, decoded once for all pages."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, Any, Final

from rmpa.web.values.codec import codec_for

if TYPE_CHECKING:
    from rmpa.web.hub.hub import Hub
    from rmpa.web.hub.requests import Payload, Received

_KEPT: Final = 16
"""Messages whose values are kept: pages watch few topics, and all get the same message at nearly the same time."""


class MessageValues:
    """Decodes messages of the hub.

    Args:
        hub: Knows the types.
    """

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._last: OrderedDict[int, tuple[Payload, Any]] = OrderedDict()

    def of(self, message: Received) -> Any:
        """The values of a message; they are shared, and must not be changed.

        Raises:
            RmpaError: Its type is not known, or its bytes are not a message of that type.
        """
        key = id(message.payload)
        known = self._last.get(key)
        if known is not None and known[0] is message.payload:  # an object's id is used again once it has gone
            return known[1]
        values = codec_for(self._hub.types.message(message.type)).json_values(message.payload)
        self._last[key] = message.payload, values
        if len(self._last) > _KEPT:
            self._last.popitem(last=False)
        return values
