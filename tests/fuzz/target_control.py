"""Fuzz target: requests and replies of the control socket."""

from __future__ import annotations

import msgspec

from rmpa.core.errors import RemoteProtocolError
from rmpa.observe.control import ControlReply, ControlRequest
from rmpa.observe.snapshot import Snapshot

SEEDS: list[bytes] = [
    b'{"op": "snapshot"}\n',
    b'{"op": "ping", "args": {"peer": "base", "count": 1}}\n',
    b'{"op": "x", "args": {"deep": [[[[[[]]]]]], "big": 1e308, "text": "\\u0000\\ud83d\\ude00"}}',
    b'{"ok": true, "value": {"times": [0.0004, null], "remote": "10.0.0.2:40001"}}\n',
    b'{"ok": false, "error": "no peer", "remedy": "did you mean base?"}\n',
    (
        b'{"ok": true, "value": {"agent": {"name": "a", "guid": "", "instance": "", "domain": 0, "core_uri": "", '
        b'"version": "", "pid": 1, "started": 0, "uptime": 0}, "taken": 0, "peers": [], "counters": {"a": 1}}}\n'
    ),
]


def fuzz(data: bytes) -> None:
    """A request or reply that survives its own round trip and is safe to log, or a documented error."""
    try:
        request = ControlRequest.parse(data)
        if ControlRequest.parse(request.serialize()) != request:
            raise AssertionError(f"{request} does not survive its round trip")
        if not str(request).isprintable():
            raise AssertionError("a request's text is not safe to log")
    except RemoteProtocolError as error:
        str(error)
    try:
        reply = ControlReply.parse(data)
        if ControlReply.parse(reply.serialize()) != reply:
            raise AssertionError("a reply does not survive its round trip")
        msgspec.convert(reply.value, Snapshot)
    except (RemoteProtocolError, msgspec.ValidationError) as error:
        str(error)
