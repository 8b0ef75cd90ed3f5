"""Serves a resource's configuration as dynamic_reconfigure does: ``set_parameters`` and its two latched topics.

The values are mirrored on the parameter server, below the name of the resource's node. They are loaded from there at
the start, so that values of a launch file or ``rmpa param set`` take effect.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import ConfigError, LocalProtocolError, RmpaError
from rmpa.resource.run.dynamic_reconfigure import (
    CONFIG_TYPE,
    CONTEXT,
    DESCRIPTION_TYPE,
    PROFILE,
    SERVICE_TYPE,
    checked,
    config,
    description,
    entries,
    from_server,
    read_config,
)
from rmpa.resource.run.runtime import RuntimePart
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.resource.declare.parameters import Parameter, ParameterValue
    from rmpa.resource.run.adapter import Adapter
    from rmpa.resource.run.contexts import Contexts
    from rmpa.resource.run.runtime import Runtime
    from rmpa.resource.run.tasks import Tasks
    from rmpa.ros.node.endpoints import Publisher

_HOLDER: Final = "configuration"
_log = logging.getLogger(__name__)
_MIRROR_TIMEOUT: Final = 1.0
"""Seconds that an ending resource waits for the parameter server."""


class Reconfigure(RuntimePart):
    """The configuration of one resource. ``load`` must be called before the other parts start, ``start`` after it.

    Args:
        runtime: The runtime of the resource.
        tasks: The resource's tasks, paused while several parameters are set.
        adapter: Applies a profile that is chosen by hand.
        contexts: Enter a context that is chosen by hand.
    """

    def __init__(self, runtime: Runtime, tasks: Tasks, adapter: Adapter, contexts: Contexts) -> None:
        self._runtime = runtime
        self._tasks = tasks
        self._adapter = adapter
        self._contexts = contexts
        self._entries = entries(runtime.resource)
        self._updates: Publisher | None = None
        self._published: Mapping[str, ParameterValue] = {}
        self._mirrored: dict[str, ParameterValue] = {}
        self._mirror: asyncio.Task[None] | None = None
        self._quiet = False
        self._lock = asyncio.Lock()

    async def start(self) -> None:
        """Advertise the topics and the service."""
        node = self._runtime.node
        described = await node.advertise(
            f"{node.name}/parameter_descriptions", MessageType(DESCRIPTION_TYPE), latch=True
        )
        described.publish(description(self._entries))
        self._updates = await node.advertise(f"{node.name}/parameter_updates", MessageType(CONFIG_TYPE), latch=True)
        self.publish()
        kind = await asyncio.to_thread(ServiceType, SERVICE_TYPE)  # reads our file of definitions
        await node.advertise_service(f"{node.name}/set_parameters", kind, self._serve)

    async def close(self) -> None:
        """Stop publishing, and finish writing to the parameter server, for at most 1 s."""
        self._updates = None
        if self._mirror is not None:
            # The next start on this core loads these values.
            await asyncio.wait([self._mirror], timeout=_MIRROR_TIMEOUT)
            self._mirror.cancel()
            await asyncio.wait([self._mirror])

    @property
    def values(self) -> dict[str, ParameterValue]:
        """The present value of each parameter, with ``profile`` and ``context`` as chosen by hand."""
        found: dict[str, Any] = {
            name: parameter.value for name, parameter in self._runtime.resource.parameters.items()
        }
        found[PROFILE] = self._adapter.loop.pinned
        if CONTEXT in self._entries:
            found[CONTEXT] = self._contexts.chosen
        return found

    async def set(self, values: Mapping[str, ParameterValue]) -> None:
        """Set parameters together.

        Raises:
            ConfigError: A value is invalid or a profile cannot be applied; nothing is changed.
            LocalProtocolError: The resource ends.
            PeerRefused: A context cannot be entered; no other value is changed.
        """
        wanted = checked(values, self._entries, self._runtime.resource.parameters)
        async with self._lock:
            if self._updates is None:
                raise LocalProtocolError(f"resource {self._runtime.resource.name} ends")
            self._quiet = True  # published together at the end
            try:
                before = self._contexts.chosen
                if wanted.get(CONTEXT, before) != before:
                    await self._contexts.choose(str(wanted[CONTEXT]))
                try:
                    await self._choose_profile(str(wanted.get(PROFILE, self._adapter.loop.pinned)))
                except RmpaError:
                    await self._contexts.choose(before)
                    raise
                await self._set_parameters({n: v for n, v in wanted.items() if n not in (PROFILE, CONTEXT)})
            finally:
                self._quiet = False
                self.publish()

    def parameter_changed(self, parameter: Parameter) -> None:  # noqa: ARG002
        """Publish the configuration."""
        self.publish()

    def changed(self) -> None:
        """Publish the configuration, because the profile or context chosen by hand may have changed."""
        self.publish()

    def publish(self) -> None:
        """Publish the configuration if it has changed, and mirror it on the parameter server."""
        values = self.values
        if self._updates is None or self._quiet or values == self._published:
            return
        self._published = values
        self._updates.publish(config(values, self._entries))
        if self._mirror is None or self._mirror.done():
            self._mirror = asyncio.get_running_loop().create_task(self._to_server(), name="mirror parameters")

    # --- inside -------------------------------------------------------------------------------------------------

    async def _serve(self, request: Any) -> dict[str, object]:
        await self.set(read_config(request.config))
        return {"config": config(self.values, self._entries)}

    async def _set_parameters(self, values: Mapping[str, ParameterValue]) -> None:
        """Set declared parameters; several are set while tasks are paused, so that no run sees only some of them."""
        if len(values) > 1:
            await self._tasks.pause(_HOLDER)
        try:
            for name, value in values.items():
                self._runtime.resource.parameters[name].value = value
        finally:
            if len(values) > 1:
                self._tasks.resume(_HOLDER)

    async def _choose_profile(self, profile: str) -> None:
        loop, before = self._adapter.loop, self._adapter.loop.pinned
        if profile == before and (not profile or profile == loop.profile):
            return
        self._adapter.pin(profile)
        await self._adapter.settled()
        if not profile or profile == loop.profile:
            return
        why = next((s.excluded for s in self._adapter.explain() if s.profile == profile), "") or "another was taken"
        self._adapter.pin(before)
        raise ConfigError(f"profile {profile}", f"it could not be applied: {why}", "what was chosen before stays")

    async def _to_server(self) -> None:
        """Write changed values to the parameter server until all are written."""
        node = self._runtime.node
        try:
            while True:
                todo = {name: v for name, v in self._published.items() if self._mirrored.get(name) != v}
                todo |= {name: v for name, v in self._published.items() if name not in self._mirrored}
                if not todo:
                    return
                for name, value in todo.items():
                    await node.set_param(f"{node.name}/{name}", value)
                    self._mirrored[name] = value
        except RmpaError as error:
            _log.debug("! %s: the parameter server: %s", node.name, error)

    async def load(self) -> None:
        """Take over the values that the parameter server holds; invalid ones are logged and left out."""
        node, resource = self._runtime.node, self._runtime.resource
        found = await node.get_param(node.name, default={})
        if not isinstance(found, dict):
            return
        taken, problems = from_server(found, self._entries, resource.parameters)
        for problem in problems:
            _log.warning("! %s: the parameter server: %s; it is left out", node.name, problem)
        for name, value in taken.items():
            if name == PROFILE:
                self._adapter.preset(str(value))
            elif name == CONTEXT:
                self._contexts.preset(str(value))
            elif not resource.parameters[name].given:
                resource.parameters[name].value = value
