"""The file that a core keeps: it is refused, or all that it holds can be kept again, shown, and said in XML-RPC."""

from __future__ import annotations

import contextlib

import msgspec

from rmpa.ros.core.state import parse, serialize
from rmpa.ros.master.api import MasterApi
from rmpa.ros.wire.xmlrpc import response_pieces

_NODE = {
    "api": "http://h:1/",
    "entries": [["publisher", "/t", "a/B"], ["subscriber", "/u", "*"], ["service", "/s", "rosrpc://h:2"]],
}
SEEDS: list[bytes] = [
    msgspec.msgpack.encode({"format": "rmpa core 2", **parts})
    for parts in (
        {"boot": "4f0c", "nodes": {"/talker": _NODE}},
        {"params": {"a": {"b": [1, "x", 2.5], "c": {}}, "e": {"k": b"\0"}}},
        {"params": {"d": msgspec.msgpack.Ext(1, b"2020-01-01T00:00:00")}},
    )
]


def fuzz(data: bytes) -> None:
    """Nothing else than ``ValueError`` is raised."""
    with contextlib.suppress(ValueError):
        _use(data)


def _use(data: bytes) -> None:
    state = parse(data)
    written = serialize(state)
    if serialize(parse(written)) != written:
        raise AssertionError("what was taken is not what is kept")
    master = MasterApi("http://h:1/", 1, lambda _: None)
    master.parameters.set("/", state.params)
    for name, node in state.nodes.items():
        for kind, key, detail in node.entries:
            master.registrations.register(kind, key, name, node.api, detail)
    for method, *arguments in (("getSystemState",), ("getParam", "/"), ("getTopicTypes",)):
        for _ in response_pieces(list(master.call(method, ["/x", *arguments]))):
            pass
