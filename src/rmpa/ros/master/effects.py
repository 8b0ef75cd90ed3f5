"""What the master asks to be done, and what it reports to have changed."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from rmpa.ros.wire.xmlrpc import XmlRpcValue


@dataclass(frozen=True, slots=True)
class PublisherUpdate:
    """Tell the slave API at ``api`` who publishes ``topic`` now (API URIs, in order of registration)."""

    api: str
    topic: str
    publishers: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ParamUpdate:
    """Tell the slave API at ``api`` that ``key``, which ends in ``/``, now is ``value``; deleted is ``{}``."""

    api: str
    key: str
    value: XmlRpcValue


@dataclass(frozen=True, slots=True)
class Shutdown:
    """Ask the node that was called ``node`` and had its slave API at ``api`` to end: another took its name.

    ``topics`` are those that it published; one of them can tell whether it still is that node.
    """

    api: str
    node: str
    topics: tuple[str, ...]


Effect: TypeAlias = PublisherUpdate | ParamUpdate | Shutdown


class RegistrationKind(enum.Enum):
    """What a node registered."""

    PUBLISHER = "publisher"
    SUBSCRIBER = "subscriber"
    SERVICE = "service"
    PARAM = "param"


@dataclass(frozen=True, slots=True)
class GraphChange:
    """One registration that came, changed its type, or went.

    Args:
        kind: What it is; parameters' subscriptions are not reported.
        added: Whether it came (or changed its type) or went.
        name: The topic or service.
        node: Whose it is.
        api: The node's XML-RPC URI.
        type: The topic's type as far as known: ``pkg/Name``, ``*`` or empty; empty for services.
    """

    kind: RegistrationKind
    added: bool
    name: str
    node: str
    api: str
    type: str = ""


@dataclass(frozen=True, slots=True)
class GraphState:
    """All registrations at one moment; never changed afterwards.

    Args:
        publishers: By topic, in order of registration: node to XML-RPC URI.
        subscribers: Likewise.
        services: By service: node to ``rosrpc://`` URI.
        types: By topic, those that ever had one.
        nodes: Node to XML-RPC URI.
    """

    publishers: dict[str, dict[str, str]]
    subscribers: dict[str, dict[str, str]]
    services: dict[str, dict[str, str]]
    types: dict[str, str]
    nodes: dict[str, str]
