"""Service types: their definitions, MD5 sums, and requests and responses as Python objects.

A definition is the request's text, a line that begins with ``---``, and the response's text (wiki.ros.org/srv). Texts
of both halves and MD5 sum are equal to genmsg's to the byte. rmpa brings the
definitions of ROS's own packages; ``ros.types.find`` finds those of this machine's packages. Unlike publishers,
servers do not send their definitions.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.ros.types.definitions import (
    Specification,
    UnknownTypeError,
    complete,
    known_text,
    packaged_texts,
    service_md5sum,
)
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.services import ServiceDescription

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

_MARK: Final = "---"


class ServiceType:
    """One service type.

    Args:
        name: ``package/Name``.
        text: The definition; by default the one that rmpa brings.
        find: Returns the own text of an embedded message type, or ``None``; by default it finds the types that rmpa
            brings itself.
        source: The file of the definition; empty for one that rmpa brings.

    Raises:
        DefinitionError: The type is not known, or malformed.
    """

    def __init__(
        self,
        name: str,
        text: str | None = None,
        find: Callable[[str], str | None] | None = None,
        source: str = "",
    ) -> None:
        self.name = name
        self.source = source
        text = text if text is not None else known_service(name)
        halves = _halves(text)
        parts = (f"{name}Request", f"{name}Response")
        known = {part: Specification.parse(part, half) for part, half in zip(parts, halves, strict=True)}
        complete(known, find if find is not None else known_text)
        self.request, self.response = (MessageType(part, known) for part in parts)
        self.md5sum = service_md5sum(*parts, known)

    def describe(self) -> ServiceDescription:
        """The description for a server's header."""
        return ServiceDescription(self.name, self.md5sum, self.request.name, self.response.name)


def _halves(text: str) -> tuple[str, str]:
    """The texts of request and response, as genmsg splits them: each line that begins with ``---`` is left out.

    All is the request where there is no such line.
    """
    halves: tuple[list[str], list[str]] = [], []
    half = halves[0]
    for line in text.split("\n"):
        if line.startswith(_MARK):
            half = halves[1]
        else:
            half.append(line + "\n")
    return "".join(halves[0]), "".join(halves[1])


def _texts() -> Mapping[str, str]:
    return packaged_texts("service_definitions.json")


def known_services() -> tuple[str, ...]:
    """The names of all service types that rmpa brings."""
    return tuple(_texts())


def known_service(name: str) -> str:
    """The definition of a service type that rmpa brings.

    Raises:
        DefinitionError: The type is not one that rmpa brings.
    """
    if name not in _texts():
        raise UnknownTypeError(
            name,
            "is not a service that comes with rmpa",
            "rmpa.ros.types.find finds those of this machine's packages",
            "service type",
        )
    return _texts()[name]
