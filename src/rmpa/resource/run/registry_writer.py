"""Writes down which resources this module's graph shows, here and in other modules, for when they are gone."""

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
"""Beside the resources' own files; no resource has a name that begins so."""
_ENDING: Final = f"/{TOPIC}"


class RegistryWriter(RuntimePart):
    """For all resources of one process: a part of one of them, which has its node.

    Args:
        runtime: Of that one.
        demands: Of that one: they listen to some descriptors too, and a node listens to a topic once.
        store: Not yet open; closed with the resource.
    """

    def __init__(self, runtime: Runtime, demands: Demands, store: ResourceStore) -> None:
        self._runtime = runtime
        self._demands = demands
        self._store = store
        self._sightings: ResourceRegistry | None = None
        """``None`` before the store has said what there was."""
        self._early: list[tuple[str, Received]] = []
        self._subscribers: dict[str, Subscriber] = {}
        self._looking: asyncio.Task[None] | None = None
        demands.on_descriptor.append(self._heard)

    @property
    def problem(self) -> str:
        """Why nothing is kept at present, or empty."""
        return f"other resources are not kept: {self._store.problem}" if self._store.problem else ""

    async def start(self) -> None:
        """Begin with what there was before."""
        self._sightings = ResourceRegistry(await self._store.open())
        for path, message in self._early:
            self._heard(path, message)
        self._looking = asyncio.get_running_loop().create_task(self._look(), name="look for resources")

    async def close(self) -> None:
        """Write what was seen last."""
        if self._looking is not None:
            self._looking.cancel()
            await asyncio.wait([self._looking])
        if self._sightings is not None:
            self._put(self._sightings.look(self._here(), time.time_ns()))
            self._put(self._sightings.end())
        await self._store.close()

    # --- inside -------------------------------------------------------------------------------------------------

    async def _look(self) -> None:
        node = self._runtime.node
        while True:
            try:
                topics = {t for t, kind in await node.get_published_topics() if kind == "std_msgs/String"}
                await self._follow({topic for topic in topics if topic.endswith(_ENDING)})
            except RmpaError as error:
                _log.debug("! %s: looking for resources: %s", node.name, error)
            if self._sightings is not None:
                self._put(self._sightings.look(self._here(), time.time_ns()))
            await asyncio.sleep(limits.KNOWN_LOOK)

    async def _follow(self, topics: set[str]) -> None:
        """Listen to what is new, and no longer to what is gone."""
        node = self._runtime.node
        own = f"{node.name}{_ENDING}"
        self._take(node.name, node.name, self._runtime.descriptor.serialize())
        for topic in self._subscribers.keys() - topics:
            await self._subscribers.pop(topic).close()
        for topic in sorted(topics - self._subscribers.keys() - self._demands.listening.keys() - {own}):
            if len(self._subscribers) >= limits.KNOWN_MAX:
                break
            heard = functools.partial(self._heard, topic.removesuffix(_ENDING))
            try:
                self._subscribers[topic] = await node.subscribe(topic, MessageType("std_msgs/String"), heard)
            except ValueError:  # an input, or a context's rule, has it
                _log.debug("= %s: listens to %s already", node.name, topic)

    def _heard(self, path: str, message: Received) -> None:
        if self._sightings is None:
            self._early.append((path, message))
        else:
            self._take(path, message.caller_id, str(message.message.data))

    def _take(self, path: str, caller: str, text: str) -> None:
        if self._sightings is None:
            return
        try:
            self._put(self._sightings.heard(path, caller, text, time.time_ns()))
        except RmpaError as error:
            _log.debug("! %s: %s: %s", self._runtime.node.name, path, error)  # somebody else's topic of that name

    def _here(self) -> set[Place]:
        name = self._runtime.node.name
        return {(name, name)} | {
            (topic.removesuffix(_ENDING), caller)
            for topic, subscriber in (*self._subscribers.items(), *self._demands.listening.items())
            for caller in subscriber.callers
        }

    def _put(self, rows: Rows) -> None:
        for key, value in rows.items():
            self._store.put(key, value)
