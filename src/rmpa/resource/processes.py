"""The nodes of a resource that exist without it: here those alone that run already."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.resource.runtime import RuntimePart
from rmpa.ros.http.rpc import call_api
from rmpa.runtime.tasks import OwnedTasks, keep_task

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from rmpa.resource.runtime import Runtime

_LOOK: Final = 1.0


class Processes(RuntimePart):
    """Nodes that run already."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._pids: dict[str, int | None] = {}
        self._work = OwnedTasks()

    async def start(self) -> None:
        """Look for the nodes."""
        for key in self._runtime.resource.nodes:
            await self._ask(key)
        if self._runtime.resource.nodes:
            self._work.add(keep_task(self._watch, "watch nodes"))

    async def close(self) -> None:
        """Look no more."""
        await self._work.close()

    async def require(self, keys: Collection[str]) -> None:
        """Refuse if a node that is needed does not run."""
        named = {key for profile in self._runtime.resource.profiles.values() for key in profile.nodes}
        for key in self._runtime.resource.nodes.keys() - named | set(keys):
            await self._ask(key)
            if self._pids[key] is None:
                raise PeerRefused(f"node {self._runtime.resource.nodes[key].name}", "it does not run", "start it")

    async def restart(self, key: str, *, args: Mapping[str, str] | None = None) -> None:  # noqa: ARG002
        """Nothing is started here."""
        raise PeerRefused(f"node {self._runtime.resource.nodes[key].name}", "it is not started here")

    def pid(self, key: str) -> int | None:
        """The process of a node."""
        return self._pids.get(key)

    async def _watch(self) -> None:
        while True:
            for key in self._runtime.resource.nodes:
                await self._ask(key)
            await asyncio.sleep(_LOOK)

    async def _ask(self, key: str) -> None:
        node, pid = self._runtime.node, None
        try:
            reply = await call_api(node.master_uri, "lookupNode", node.name, self._runtime.resource.nodes[key].name)
            if reply.code == 1:
                found = (await call_api(str(reply.value), "getPid", node.name, timeout=1.0)).value
                pid = found if isinstance(found, int) else None
        except RmpaError:
            pass
        self._pids[key] = pid
