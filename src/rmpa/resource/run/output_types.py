"""Learns the types of outputs that are unknown on this machine from a publisher, in this module or at a peer."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from rmpa.core.errors import UnreachableError
from rmpa.ros import limits
from rmpa.ros.node.fetch_type import fetch_type
from rmpa.ros.wire.tcpros import printable

if TYPE_CHECKING:
    from rmpa.resource.declare.connections import Output
    from rmpa.resource.declare.resource import Resource

_log = logging.getLogger(__name__)


async def learn_outputs(resource: Resource, master_uri: str, caller_id: str) -> None:
    """Wait until the type of each output is known; missing types and the places searched for them are logged once.

    Args:
        resource: The resource, completely declared; the function sets the types of its outputs.
        master_uri: URI of the master whose publishers are queried.
        caller_id: Name of the resource's node, which need not be registered yet.
    """
    logged: set[str] = set()
    while missing := [output for output in resource.outputs.values() if output.kind.known is None]:
        for output in missing:
            if await _learn(output, master_uri, caller_id) or output.kind.name in logged:
                continue
            logged.add(output.kind.name)
            _log.warning("! %s waits for the type of output %s: %s", caller_id, output.name, output.kind.problem)
        if any(output.kind.known is None for output in missing):
            await asyncio.sleep(limits.TYPE_LOOK)


async def _learn(output: Output, master_uri: str, caller_id: str) -> bool:
    try:
        learnt = await fetch_type(master_uri, caller_id, output.kind.name)
    except UnreachableError as error:
        _log.debug("! %s: %s", caller_id, error)  # the resource's start reports an unreachable master
        return False
    if learnt is not None:
        output.kind.known = learnt.kind
        whence = printable(learnt.node), printable(learnt.topic)
        _log.info("= %s: %s is learnt from %s, which publishes %s", caller_id, output.kind.name, *whence)
    return learnt is not None
