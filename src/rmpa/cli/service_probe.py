"""Finds the server of a service at the master, and asks it for the service's type."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RmpaError, UnreachableError
from rmpa.ros import limits
from rmpa.ros.http.rpc import call_api
from rmpa.ros.types.find import find_service_type

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.cli.master import Master
    from rmpa.ros.types.installed import ServiceType
    from rmpa.ros.wire.tcpros import ServiceDescription

CALLER_ID: Final = "/rmpa_service"
_AT_ONCE: Final = 16
"""Servers that are asked at the same time."""


@dataclass(frozen=True, slots=True)
class Probed:
    """The answer of a service's server.

    Args:
        uri: Its address; empty if the master does not know it.
        description: The service's type and MD5 sum; ``None`` if the server does not answer.
        problem: Why it does not answer.
    """

    uri: str = ""
    description: ServiceDescription | None = None
    problem: str = ""


async def lookup(master: Master, name: str) -> str:
    """The address of a service's server, ``rosrpc://host:port``.

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
    """Ask a service's server for its type; an error of the server is in the answer.

    Raises:
        UnreachableError: The master does not answer.
    """
    from rmpa.ros.node.endpoints import probe as ask

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
    """The definition of the type that a server names, from this machine's packages or from rmpa's own.

    Raises:
        DefinitionError: It is not known here, or only in another version.
    """
    return find_service_type(description.type, description.md5sum)
