"""The part of the neighbour "other sites" that keeps what came of their latched topics, for when a site is off."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rmpa.gateway.sites.last_values import LastValue, ValueHeader, ValueKey
from rmpa.gateway.sites.part import PassivePart

if TYPE_CHECKING:
    from rmpa.gateway.sites.io.last_value_store import LastValueStore
    from rmpa.gateway.sites.keys import SiteModule
    from rmpa.ros.wire.tcpros import TopicDescription


class SiteSeenValues(PassivePart):
    """Last values of other sites, as far as they came here: a ``SitePart``.

    Descriptors of Smart Resources are among them. Nothing is asked for: what no node here subscribed to was not seen.

    Args:
        store: A file of its own, so that other sites cannot push out what this one keeps of itself. In its keys the
            module is ``<site>/<module>``. This part opens and closes it.
    """

    name = "seen_values"

    def __init__(self, store: LastValueStore) -> None:
        self._store = store
        self._opening = asyncio.get_running_loop().create_task(store.open(), name="open values of other sites")

    def keep(
        self, module: SiteModule, topic: str, node: str, description: TopicDescription, stamp: int, body: bytes
    ) -> None:
        """Keep the message of a latched topic in place of the one before.

        Args:
            module: The module that has it.
            topic: The topic in its graph.
            node: Its publisher there.
            description: Its publisher's header.
            stamp: When the gateway there received it, nanoseconds since 1970.
            body: The TCPROS message without its length.
        """
        value = LastValue(
            description.type, description.md5sum, description.definition, description.latching, stamp, body
        )
        self._store.put(ValueKey(_module(module.site, module.name), topic, node), value)

    async def of_site(self, site: str) -> dict[ValueKey, ValueHeader]:
        """The headers of all that is kept of a site; the keys name its modules alone."""
        await asyncio.shield(self._opening)
        head = _module(site, "")
        return {
            ValueKey(key.module.removeprefix(head), key.topic, key.node): header
            for key, header in self._store.headers.items()
            if key.module.startswith(head)
        }

    async def body(self, site: str, key: ValueKey) -> bytes | None:
        """The message of a value; ``None`` if there is none, or the disk does not give it in time."""
        await asyncio.shield(self._opening)
        return await self._store.body(ValueKey(_module(site, key.module), key.topic, key.node))

    def report(self) -> dict[str, object]:
        """How many values are kept, as JSON values."""
        return {"values": len(self._store.headers), "problem": self._store.problem, "dropped": self._store.dropped}

    async def close(self) -> None:
        """Write what waits, and end."""
        await self._opening
        await self._store.close()


def _module(site: str, module: str) -> str:
    return f"{site}/{module}"
