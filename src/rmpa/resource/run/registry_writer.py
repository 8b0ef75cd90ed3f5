"""Records the resources that this module's graph has shown: those of this module and of others."""

from __future__ import annotations

import asyncio
import functools
import logging
import time
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RmpaError
from rmpa.resource import limits
from rmpa.resource.run.descriptor import TOPIC
from rmpa.resource.run.resource_registry import Place, ResourceRegistry
from rmpa.resource.run.runtime import RuntimePart
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from rmpa.resource.run.demands import Demands
    from rmpa.resource.run.resource_registry import Rows
    from rmpa.resource.run.runtime import Runtime
    from rmpa.resource.run.store import ResourceStore
    from rmpa.ros.node.topics import Received, Subscriber

_log = logging.getLogger(__name__)
FILE: Final = "_known.sqlite"
"""Name of the registry's file, beside the resources' own files; no resource's name begins with ``_``."""
_ENDING: Final = f"/{TOPIC}"


class RegistryWriter(RuntimePart):
    """Writes the registry of a process; it is a part of one resource of the process and uses that resource's node.

    Args:
        runtime: The runtime of that resource.
        demands: That resource's requirements on others. They subscribe to some descriptors already, and a node may
            subscribe to a topic only once.
        store: The registry's store, not yet open; closed with the resource.
    """

    def __init__(self, runtime: Runtime, demands: Demands, store: ResourceStore) -> None:
        self._runtime = runtime
        self._demands = demands
        self._store = store
        self.registry: ResourceRegistry | None = None
        """``None`` until the store has been read."""
        self._early: list[tuple[str, Received]] = []
        self._subscribers: dict[str, Subscriber] = {}
        self._scanning: asyncio.Task[None] | None = None

    @property
    def problem(self) -> str:
        """Why nothing can be stored at present; empty if storing works."""
        return f"other resources are not kept: {self._store.problem}" if self._store.problem else ""

    async def start(self) -> None:
        """Read the stored registry, and scan the graph from now on."""
        self.registry = ResourceRegistry(await self._store.open())
        for resource, message in self._early:
            self.descriptor_received(resource, message)
        self._scanning = asyncio.get_running_loop().create_task(self._scan(), name="look for resources")

    async def close(self) -> None:
        """Stop the scans, write the times when the present resources were last seen, and close the store."""
        if self._scanning is not None:
            self._scanning.cancel()
            await asyncio.wait([self._scanning])
        if self.registry is not None:
            self._put(self.registry.update(self._present(), time.time_ns()))
            self._put(self.registry.flush())
        await self._store.close()

    # --- inside -------------------------------------------------------------------------------------------------

    async def _scan(self) -> None:
        node = self._runtime.node
        while True:
            try:
                topics = {t for t, kind in await node.get_published_topics() if kind == "std_msgs/String"}
                await self._follow({topic for topic in topics if topic.endswith(_ENDING)})
            except RmpaError as error:
                _log.debug("! %s: looking for resources: %s", node.name, error)
            if self.registry is not None:
                self._put(self.registry.update(self._present(), time.time_ns()))
            await asyncio.sleep(limits.KNOWN_LOOK)

    async def _follow(self, topics: set[str]) -> None:
        """Subscribe to new descriptors, and unsubscribe from those that are gone."""
        node = self._runtime.node
        own = f"{node.name}{_ENDING}"
        self._record(node.name, node.name, self._runtime.descriptor.serialize())
        for topic in self._subscribers.keys() - topics:
            await self._subscribers.pop(topic).close()
        for topic in sorted(topics - self._subscribers.keys() - self._demands.descriptors.keys() - {own}):
            if len(self._subscribers) >= limits.KNOWN_MAX:
                break
            callback = functools.partial(self.descriptor_received, topic.removesuffix(_ENDING))
            try:
                self._subscribers[topic] = await node.subscribe(topic, MessageType("std_msgs/String"), callback)
            except ValueError:  # an input or a rule of a context has subscribed
                _log.debug("= %s: listens to %s already", node.name, topic)

    def descriptor_received(self, resource: str, message: Received) -> None:
        """Record a resource whose descriptor has arrived; the message waits until the store has been read."""
        if self.registry is None:
            self._early.append((resource, message))
        else:
            self._record(resource, message.caller_id, str(message.message.data))

    def _record(self, path: str, caller: str, text: str) -> None:
        if self.registry is None:
            return
        try:
            self._put(self.registry.record(path, caller, text, time.time_ns()))
        except RmpaError as error:
            _log.debug(
                "! %s: %s: %s", self._runtime.node.name, path, error
            )  # another topic may have the same name and hold no descriptor

    def _present(self) -> set[Place]:
        name = self._runtime.node.name
        return {(name, name)} | {
            (topic.removesuffix(_ENDING), caller)
            for topic, subscriber in (*self._subscribers.items(), *self._demands.descriptors.items())
            for caller in subscriber.callers
        }

    def _put(self, rows: Rows) -> None:
        for key, value in rows.items():
            self._store.put(key, value)
