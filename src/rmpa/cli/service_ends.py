"""Where a service is, and what it is: asked of the master, and of the service's server by a probe."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.bridge.proxy_names import proxied_node
from rmpa.config.values import did_you_mean
from rmpa.core.errors import RmpaError, UnreachableError
from rmpa.ros import limits
from rmpa.ros.http.client import call_api
from rmpa.ros.types.find import find_service_type

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.cli.master import Graph, Master, TopicName
    from rmpa.ros.types.service_types import ServiceType
    from rmpa.ros.wire.services import ServiceDescription

CALLER_ID: Final = "/rmpa_service"
_AT_ONCE: Final = 16


@dataclass(frozen=True, slots=True)
class Probed:
    """What a service's server says.

    Args:
        uri: Where it was asked; empty if the master does not know that.
        description: What it says, or ``None``.
        problem: Why it does not say anything.
    """

    uri: str = ""
    description: ServiceDescription | None = None
    problem: str = ""


def require_service(graph: Graph, wanted: TopicName) -> str:
    """See that a service is there; return the node that serves it.

    Raises:
        RmpaError: It is not, or not that peer's; the nearest one is offered.
    """
    name = wanted.topic
    if name not in graph.services:
        near = did_you_mean(name, graph.services)
        raise RmpaError(
            f"no service {name}; " + (f"did you mean {near}?" if near else "`rmpa service list` shows all")
        )
    nodes = graph.services[name]
    if wanted.peer is not None and not any(map(wanted.takes, nodes)):
        remedy = f"what {wanted.peer} offers under this name is hidden by it, if there is any"
        raise RmpaError(f"service {name} is served by {', '.join(nodes)}, not by peer {wanted.peer}; {remedy}")
    return nodes[0] if nodes else ""


def service_peers(graph: Graph, name: str) -> list[str]:
    """The peers that serve a service; one at the most, but for masters that are wrong."""
    remote = (proxied_node(node) for node in graph.services.get(name, ()))
    return sorted({r[0] for r in remote if r is not None})


async def lookup(master: Master, name: str) -> str:
    """Where a service is served, ``rosrpc://host:port``.

    Raises:
        UnreachableError: The master does not answer.
        RmpaError: It knows no such service.
    """
    try:
        reply = await call_api(master.uri, "lookupService", CALLER_ID, name)
    except UnreachableError:
        raise master.unreachable() from None
    if reply.code != 1:
        raise RmpaError(f"no service {name} is registered at {master.uri}; `rmpa service list` shows all")
    return str(reply.value)


async def probe(master: Master, name: str) -> Probed:
    """Ask a service's server what it is; errors are in the answer.

    Raises:
        UnreachableError: The master does not answer.
    """
    from rmpa.ros.node.services import probe as ask

    uri = ""
    try:
        uri = await lookup(master, name)
        return Probed(uri, (await ask(uri, name, CALLER_ID, limits.SERVICE_OPEN_TIMEOUT)).description)
    except RmpaError as error:
        return Probed(uri, None, str(error))


async def probe_all(master: Master, names: Iterable[str]) -> dict[str, Probed]:
    """Ask the servers of several services at once."""
    turns = asyncio.Semaphore(_AT_ONCE)

    async def one(name: str) -> tuple[str, Probed]:
        async with turns:
            return name, await probe(master, name)

    return dict(await asyncio.gather(*map(one, names)))


def known_type(description: ServiceDescription) -> ServiceType:
    """The type that a server names, as this machine's packages or we ourselves know it.

    Raises:
        DefinitionError: It is not known here, or in another version.
    """
    return find_service_type(description.type, description.md5sum)
