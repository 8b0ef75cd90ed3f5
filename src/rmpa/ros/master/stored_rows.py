"""Converts a core's registrations and parameters to rows of its state file, and back.

A row is ``(kind, name, value)``::

    ("node", "/talker", JSON of a NodeRecord)
    ("param", JSON list of its namespaces and its name, MessagePack)
    ("run", "", the boot of the machine in which a core runs; empty once it has ended in order)

A parameter's row is one value, or one empty namespace. Rows that are read are checked: bad ones are reported and left
out, the rest is used.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import msgspec

from rmpa.core.sizes import INT32_MAX, INT32_MIN
from rmpa.ros import limits
from rmpa.ros.master.effects import RegistrationKind
from rmpa.ros.master.unverified import NodeRecord
from rmpa.ros.wire.xmlrpc import brief
from rmpa.ros.wire.xmlrpc_writer import legal_text

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from rmpa.core.yielding import Yielder
    from rmpa.ros.master.parameters import Tree
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

NODE: Final = "node"
PARAM: Final = "param"
RUN: Final = ("run", "")
"""The key of the row that tells a core that died from one that was ended."""
Key: TypeAlias = tuple[str, str]
"""Kind and name of a row."""
Row: TypeAlias = tuple[str, str, bytes]
Path: TypeAlias = tuple[str, ...]
"""The names of a parameter's namespaces, then its own; a name may hold a slash where a struct was set."""

_DATETIME: Final = 1
"""A MessagePack extension: XML-RPC's dates have no time zone, and MessagePack's have one."""
_RUN: Final = 256
"""Elements of a list that are packed at once, which takes some 10 microseconds."""
_GONE: Final = object()
_pack = msgspec.msgpack.Encoder().encode
_CONTAINERS: Final = (dict, list, tuple)


class NotStorableError(Exception):
    """A value that cannot be stored; the text has the reason. Only ``StateWriter`` handles it."""


@dataclass(slots=True)
class StoredRegistrations:
    """The content of a state file.

    Args:
        nodes: Records by the node's name.
        tree: The parameters.
        lost: Rows that could not be read, as texts for the log.
        boot: In which boot of the machine the run died; empty if it ended in order.
    """

    nodes: dict[str, NodeRecord] = field(default_factory=dict)
    tree: Tree = field(default_factory=dict)
    lost: list[str] = field(default_factory=list)
    boot: str = ""


# --- parameters as rows ---------------------------------------------------------------------------------------


def param_key(path: Path) -> Key:
    """The key of a parameter's row."""
    return PARAM, msgspec.json.encode(path).decode()


def changed_params(before: Tree, after: Tree) -> Iterator[tuple[Path, XmlRpcValue | None]]:
    """The parameters that differ between two trees, with their values in ``after``; ``None`` for deleted ones.

    Trees are never changed in place, so parts that both share are skipped.
    """
    waiting: list[tuple[Path, Mapping[str, Any], Mapping[str, Any]]] = [((), before, after)]
    while waiting:
        path, old, new = waiting.pop()
        for name, was in old.items():
            now = new.get(name, _GONE)
            if now is was:
                continue
            if _is_namespace(was) and not _is_namespace(now):
                yield from ((leaf, None) for leaf in _leaves((*path, name), was))
            elif not _is_namespace(was) and (now is _GONE or _is_namespace(now)):
                yield (*path, name), None
        for name, now in new.items():
            was = old.get(name, _GONE)
            if now is was:
                continue
            if _is_namespace(now):
                waiting.append(((*path, name), was if _is_namespace(was) else {}, now))
            elif was is _GONE or type(was) is not type(now) or isinstance(now, _CONTAINERS) or was != now:
                yield (*path, name), now


def _is_namespace(value: object) -> bool:
    """Whether a value has rows below it instead of one of its own."""
    return isinstance(value, dict) and bool(value)


def _leaves(path: Path, tree: Mapping[str, Any]) -> Iterator[Path]:
    waiting = [(path, tree)]
    while waiting:
        above, names = waiting.pop()
        for name, value in names.items():
            if _is_namespace(value):
                waiting.append(((*above, name), value))
            else:
                yield (*above, name)


def packed(value: XmlRpcValue, yielder: Yielder = iter) -> bytes:
    """A parameter's value as MessagePack.

    Raises:
        NotStorableError: MessagePack cannot express it.
    """
    try:
        return b"".join(yielder(_pieces(value)))
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise NotStorableError(f"{type(error).__name__}: {error}") from None


def _pieces(value: Any) -> Iterator[bytes]:
    match value:
        case dict():
            yield _head(0x80, 0xDE, len(value))
            for name, part in value.items():
                yield _pack(str(name))
                yield from _pieces(part)
        case list() | tuple():
            yield _head(0x90, 0xDC, len(value))
            for begin in range(0, len(value), _RUN):
                run = value[begin : begin + _RUN]
                if any(isinstance(part, _CONTAINERS) or type(part) is datetime for part in run):
                    for part in run:
                        yield from _pieces(part)
                else:
                    yield _pack(run)[len(_head(0x90, 0xDC, len(run))) :]
        case datetime():
            yield _pack(msgspec.msgpack.Ext(_DATETIME, value.isoformat().encode()))
        case _:
            yield _pack(value)


def _head(short: int, long: int, count: int) -> bytes:
    """The head of an array or map (MessagePack specification)."""
    if count < 16:
        return bytes([short | count])
    if count < 1 << 16:
        return bytes([long]) + count.to_bytes(2, "big")
    return bytes([long + 1]) + count.to_bytes(4, "big")


def _unpacked_ext(code: int, data: memoryview) -> datetime:
    if code != _DATETIME:
        raise ValueError(f"extension {code}")
    return datetime.fromisoformat(bytes(data).decode())


_unpack = msgspec.msgpack.Decoder(ext_hook=_unpacked_ext).decode


# --- reading --------------------------------------------------------------------------------------------------


def read(rows: Iterable[Row]) -> StoredRegistrations:
    """Read rows. Those that are damaged, or that no call of a node could have caused, are reported in ``lost``."""
    kept = StoredRegistrations()
    for kind, name, value in rows:
        try:
            match kind:
                case "node":
                    kept.nodes[name] = _node(name, value)
                case "run":
                    kept.boot = value.decode()
                case "param":
                    _put(kept.tree, _path(name), _value(value))
                case _:
                    kept.lost.append(f"{brief(kind)} {brief(name)}: there is no such kind of row")
        except (ValueError, TypeError, RecursionError, msgspec.MsgspecError) as error:
            kept.lost.append(f"{brief(kind)} {brief(name)}: {type(error).__name__}: {error}")
    return kept


def _node(name: str, row: bytes) -> NodeRecord:
    record = msgspec.json.decode(row, type=NodeRecord)
    for text in (name, *record.publishers, *record.subscribers, *record.services, *record.params):
        if not text.startswith("/") or len(text) > limits.CORE_STATE_NAME_MAX:
            raise ValueError(f"{brief(text)} is no global name")
    if not record.api.startswith("http://"):
        raise ValueError(f"{brief(record.api)} is no URI of a slave API")
    _check_text(name + record.api)
    for kind in RegistrationKind:
        for key, value in record.of(kind).items():
            _check_text(f"{key} {value}")
    return record


def _check_text(text: str) -> None:
    """Raise ``ValueError`` if XML cannot hold the text: no response with it could be written."""
    if legal_text(text) != text:
        raise ValueError(f"{brief(text)} has a character that XML cannot hold")


def _path(name: str) -> Path:
    path = tuple(msgspec.json.decode(name, type=list[str]))
    if not path or len(path) > limits.XMLRPC_DEPTH_MAX:
        raise ValueError("it names no parameter")
    for part in path:
        _check_text(part)
    return path


def _value(value: bytes) -> Any:
    found = _unpack(value)
    waiting = [found]
    while waiting:
        match waiting.pop():
            case bool() | float() | bytes() | datetime():
                pass
            case str(text):
                _check_text(text)
            case int(number) if INT32_MIN <= number <= INT32_MAX:
                pass
            case list() as parts:
                waiting += parts
            case dict() as parts if all(isinstance(name, str) for name in parts):
                waiting += [*parts.values(), *parts]
            case other:
                raise ValueError(f"{brief(other)} is nothing that XML-RPC can say")
    return found


def _put(tree: Tree, path: Path, value: Any) -> None:
    """Put a value into a tree that is being built."""
    at: Any = tree
    for name in path[:-1]:
        at = at.setdefault(name, {})
        if not isinstance(at, dict):
            raise ValueError("something above it is no namespace")  # noqa: TRY004 - of the file, not of a caller
    if path[-1] in at:
        raise ValueError("it stands there twice")
    at[path[-1]] = value
