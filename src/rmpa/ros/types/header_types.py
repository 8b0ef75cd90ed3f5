"""Finds the message type of a connection header; results are cached, so it can be called for each message."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from time import monotonic
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RmpaError
from rmpa.ros import limits
from rmpa.ros.types.find import EMPTY_MD5, message_with_sum
from rmpa.ros.types.installed import SearchPath
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from collections.abc import Mapping

_missing: OrderedDict[tuple[str, str, SearchPath], tuple[float, RmpaError]] = OrderedDict()
"""Types that were not found: the time of the search (monotonic seconds) and the error; the oldest first."""
_missing_lock: Final = threading.Lock()


def _unless_missing(name: str, md5: str, path: SearchPath) -> MessageType:
    """Find a message type with a sum; repeat the error of a search that failed within ``limits.TYPE_MISSING``."""
    key = name, md5, path
    with _missing_lock:
        when, error = _missing.get(key, (0.0, None))
        if error is not None and monotonic() - when >= limits.TYPE_MISSING:
            del _missing[key]
            error = None
    if error is not None:
        raise error.with_traceback(None)  # the traceback would grow with each message
    try:
        return message_with_sum(name, md5, path)
    except RmpaError as problem:
        with _missing_lock:
            _missing[key] = monotonic(), problem
            _missing.move_to_end(key)
            while len(_missing) > limits.TYPES_MISSING_MAX:
                _missing.popitem(last=False)
        raise


def type_of_header(fields: Mapping[str, str]) -> MessageType:
    """The message type of a publisher's connection header: from its definition, else as found on this machine.

    May be called for each message: results are cached, and a failed search is not repeated within
    ``limits.TYPE_MISSING`` seconds.

    Raises:
        DefinitionError: As for ``MessageType.learn`` and ``find_message_type``.
    """
    name, md5 = fields.get("type", ""), fields.get("md5sum", "")
    definition = fields.get("message_definition", "")
    if definition or md5 == EMPTY_MD5:
        return MessageType.learn(name, definition, md5)
    return _unless_missing(name, md5, SearchPath.read(os.environ))
