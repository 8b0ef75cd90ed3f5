"""Calls to slave APIs that follow from a change in the master's tables, and reports of changes."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from rmpa.ros.wire.xmlrpc import XmlRpcValue


@dataclass(frozen=True, slots=True)
class PublisherUpdate:
    """``publisherUpdate`` for the slave API at ``api``: the publishers of ``topic``, in order of registration."""

    api: str
    topic: str
    publishers: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ParamUpdate:
    """``paramUpdate`` for the slave API at ``api``: ``key``, which ends in ``/``, is ``value``; ``{}`` if deleted."""

    api: str
    key: str
    value: XmlRpcValue


@dataclass(frozen=True, slots=True)
class Shutdown:
    """``shutdown`` for ``node`` at the slave API ``api``, because another node has taken its name.

    ``topics`` are those that it published: the header of one shows whether that node is still at the address.
    """

    api: str
    node: str
    topics: tuple[str, ...]


Effect: TypeAlias = PublisherUpdate | ParamUpdate | Shutdown


class RegistrationKind(enum.Enum):
    """The kinds of registration at a master."""

    PUBLISHER = "publisher"
    SUBSCRIBER = "subscriber"
    SERVICE = "service"
    PARAM = "param"


@dataclass(frozen=True, slots=True)
class GraphChange:
    """One registration that was added or removed, or changed its type.

    Args:
        kind: Its kind; subscriptions to parameters are not reported.
        added: Whether it was added (or changed its type) or removed.
        name: The topic or service.
        node: The node that registered it.
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
        subscribers: By topic: node to XML-RPC URI.
        services: By service: node to ``rosrpc://`` URI.
        types: By topic, also of topics without registrations.
        nodes: Node to XML-RPC URI.
    """

    publishers: dict[str, dict[str, str]]
    subscribers: dict[str, dict[str, str]]
    services: dict[str, dict[str, str]]
    types: dict[str, str]
    nodes: dict[str, str]
