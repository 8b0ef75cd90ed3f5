"""Rows of the file that a core keeps: whatever is in them, the rest is taken and what cannot be is named."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.ros.master import stored_rows
from rmpa.ros.master.master_api import MasterApi
from rmpa.ros.wire.xmlrpc import response_pieces

if TYPE_CHECKING:
    from rmpa.ros.master.parameters import Tree

_SEPARATOR = b"\xfe\xfd"
_NODE = b'{"api":"http://h:1/","publishers":{"/t":"a/B"},"subscribers":{"/u":"*"},"services":{"/s":"rosrpc://h:2"}}'
SEEDS: list[bytes] = [
    _SEPARATOR.join([b"node", b"/talker", _NODE]),
    _SEPARATOR.join([b"param", b'["a","b"]', b"\x93\x01\xa1x\xcb@\x04\0\0\0\0\0\0", b"param", b'["a"]', b"\x80"]),
    _SEPARATOR.join(
        [b"param", b'["d"]', b"\xc7\x13\x012020-01-01T00:00:00", b"param", b'["e"]', b"\x81\xa1k\xc4\x01\0"]
    ),
]


def fuzz(data: bytes) -> None:
    """Nothing is raised, and what was taken can be kept again, shown, and said in XML-RPC."""
    parts = data.split(_SEPARATOR)
    rows = [
        (parts[i].decode("latin-1"), parts[i + 1].decode("latin-1"), parts[i + 2])
        for i in range(0, len(parts) - 2, 3)
    ]
    found = stored_rows.read(rows)
    again = _rows(found.tree)
    if again != _rows(stored_rows.read([(*key, value) for key, value in again.items()]).tree):
        raise AssertionError("what was taken is not what is kept")
    master = MasterApi("http://h:1/", 1, lambda _: None)
    master.parameters.set("/", found.tree)
    for node, record in found.nodes.items():
        master.registrations.restore(node, record)
        master.registrations.confirm(node)
    for method, *arguments in (("getSystemState",), ("getParam", "/"), ("getTopicTypes",)):
        for _ in response_pieces(list(master.call(method, ["/x", *arguments]))):
            pass


def _rows(tree: Tree) -> dict[stored_rows.Key, bytes]:
    changed = stored_rows.changed_params({}, tree)
    return {stored_rows.param_key(path): stored_rows.packed(value) for path, value in changed if value is not None}
