"""The ROS 1 definition of a type that only ROS 2 defines: a node of ROS 1 can ask for it by name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rosbags.interfaces import Nodetype

from rmpa.ros.types.definitions import SEPARATOR, known_text
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from collections.abc import Callable

    from rosbags.typesys.store import Typestore

_EMPTY_MEMBER: Final = "structure_needs_at_least_one_member"
_TIMES: Final = {"builtin_interfaces/msg/Time": "time", "builtin_interfaces/msg/Duration": "duration"}
_BASES: Final = {"octet": "byte", "wstring": "string"}


def derive_ros1(store: Typestore, name: str, name1: Callable[[str], str]) -> MessageType:
    """Make the ROS 1 form of a type of ROS 2.

    Times become ``time`` and ``duration``, bounds are left out, and an embedded type that ROS 1 defines too is
    ROS 1's: a header has ``seq``.

    Args:
        store: The types of ROS 2.
        name: ``package/msg/Name``.
        name1: The name of ROS 1 for one of ROS 2's types.

    Raises:
        KeyError: An embedded type is not known.
        DefinitionError: It has a field that ROS 1 cannot have.
    """
    own = name1(name)
    texts = _texts(store, [name], name1)
    blocks = [texts.pop(own), *(f"{SEPARATOR}\nMSG: {key}\n{text}" for key, text in texts.items())]
    return MessageType.learn(own, "\n".join(blocks))


def derive_service(store: Typestore, name: str, own: str, name1: Callable[[str], str]) -> ServiceType:
    """Make the ROS 1 form of a service type of ROS 2; fields and errors as for ``derive_ros1``.

    Args:
        store: The types of ROS 2, with request and response of the service.
        name: ``package/srv/Name``.
        own: ``package/Name`` of ROS 1.
        name1: The name of ROS 1 for one of ROS 2's message types.
    """
    halves = {f"{name}_Request": f"{own}Request", f"{name}_Response": f"{own}Response"}
    texts = _texts(store, list(halves), lambda each: halves.get(each) or name1(each))
    return ServiceType(own, "\n---\n".join(texts.pop(half) for half in halves.values()), texts.get)


def _texts(store: Typestore, names: list[str], name1: Callable[[str], str]) -> dict[str, str]:
    """The own texts of some types, and of all that they embed, by their names of ROS 1."""
    texts: dict[str, str] = {}
    todo = list(names)
    roots = {name1(name) for name in names}
    while todo:
        each = todo.pop()
        key = name1(each)
        if key in texts:
            continue
        text = known_text(key) if key not in roots else None
        texts[key] = text if text is not None else _text(store, each, name1)
        if text is None:
            todo += [inner for inner in _embedded(store, each) if inner not in _TIMES]
        else:  # ROS 1's type may embed others, which rmpa brings too
            todo += [_back(inner) for inner in MessageType(key).specifications if inner != key]
    return texts


def _back(name: str) -> str:
    package, _, base = name.partition("/")
    return f"{package}/msg/{base}"


def _embedded(store: Typestore, name: str) -> list[str]:
    inner = [_inner(desc) for _, desc in store.fielddefs[name][1]]
    return [str(desc[1]) for desc in inner if desc[0] == Nodetype.NAME]


def _inner(desc: Any) -> Any:
    return desc[1][0] if desc[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) else desc


def _text(store: Typestore, name: str, name1: Callable[[str], str]) -> str:
    constants, fields = store.fielddefs[name]
    lines = [f"{_BASES.get(kind, kind)} {key}={value}" for key, kind, value in constants]
    lines += [f"{_kind(desc, name1)} {key}" for key, desc in fields if key != _EMPTY_MEMBER]
    return "\n".join(lines)


def _kind(desc: Any, name1: Callable[[str], str]) -> str:
    inner = _inner(desc)
    if inner[0] == Nodetype.NAME:
        kind = _TIMES.get(inner[1]) or name1(inner[1])
    else:
        kind = _BASES.get(inner[1][0], inner[1][0])
    if desc[0] == Nodetype.ARRAY:
        return f"{kind}[{desc[1][1]}]"
    return f"{kind}[]" if desc[0] == Nodetype.SEQUENCE else kind
