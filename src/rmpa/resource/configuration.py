"""A resource as a server of dynamic_reconfigure: a service and two topics (messages: ``resource.reconfigure``).

The values are mirrored on the parameter server, below the name of the resource's node. They are loaded from there at
the start, so that values of a launch file or ``rmpa param set`` take effect.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import ConfigError, LocalProtocolError, RmpaError
from rmpa.resource import reconfigure
from rmpa.resource.reconfigure import CONTEXT, DESCRIPTION_TYPE, PROFILE, checked, config
from rmpa.resource.runtime import RuntimePart
from rmpa.ros.types.descriptor import CONFIG_TYPE, SERVICE_TYPE
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType
from rmpa.runtime.tasks import end_tasks, start_task

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.resource.actuation import Actuation
    from rmpa.resource.adapter import Adapter
    from rmpa.resource.contexts import Contexts
    from rmpa.resource.declare import Parameter, ParameterValue
    from rmpa.resource.runtime import Runtime
    from rmpa.resource.tasks import Tasks
    from rmpa.ros.node.endpoints import Publisher

_log = logging.getLogger(__name__)
_HOLDER: Final = "configuration"
# Seconds that an ending resource waits for the parameter server.
_MIRROR_TIMEOUT: Final = 1.0


class Reconfigure(RuntimePart):
    """The configuration of one resource. ``load`` must be called before the other parts start, ``start`` after it.

    Args:
        runtime: The runtime of the resource.
        tasks: The resource's tasks, paused while several parameters are set.
        actuation: Sets the parameters that other nodes have.
        adapter: Applies a profile that is chosen by hand.
        contexts: Enter a context that is chosen by hand.
    """

    def __init__(
        self, runtime: Runtime, tasks: Tasks, actuation: Actuation, adapter: Adapter, contexts: Contexts
    ) -> None:
        self._runtime = runtime
        self._tasks = tasks
        self._actuation = actuation
        self._adapter = adapter
        self._contexts = contexts
        self._known = reconfigure.entries(runtime.resource)
        self._updates: Publisher | None = None
        self._published: Mapping[str, ParameterValue] = {}
        self._mirrored: dict[str, ParameterValue] = {}
        self._mirror: asyncio.Task[None] | None = None
        self._quiet = False
        self._lock = asyncio.Lock()

    async def load(self) -> None:
        """Take over the values that the parameter server holds; invalid ones are logged and left out."""
        node = self._runtime.node
        found: Any = await node.get_param(node.name, default={})
        for name in self._known if isinstance(found, dict) else ():
            if name not in found:
                continue
            try:
                value = checked(name, found[name], self._known)
            except ConfigError as error:
                _log.warning("! %s: from the parameter server: %s; it is ignored [invalid-value]", node.name, error)
                continue
            if name == PROFILE:
                self._adapter.preset = str(value)
            elif name == CONTEXT:
                self._contexts.chosen = str(value)
            elif not self._known[name].given and self._known[name].binding is None:
                self._known[name].value = value

    async def start(self) -> None:
        """Advertise the topics and the service."""
        node, kind = self._runtime.node, MessageType(DESCRIPTION_TYPE)
        described = await node.advertise(f"{node.name}/parameter_descriptions", kind, latch=True)
        described.publish(reconfigure.description(self._known))
        self._updates = await node.advertise(f"{node.name}/parameter_updates", MessageType(CONFIG_TYPE), latch=True)
        self.changed()
        service = await asyncio.to_thread(ServiceType, SERVICE_TYPE)  # reads our file of definitions
        await node.advertise_service(f"{node.name}/set_parameters", service, self._serve)

    async def close(self) -> None:
        """Stop publishing, and finish writing to the parameter server, for at most 1 s."""
        self._updates = None
        if self._mirror is not None:
            # The next start on this core loads these values.
            await asyncio.wait([self._mirror], timeout=_MIRROR_TIMEOUT)
            await end_tasks(self._mirror)

    @property
    def values(self) -> dict[str, ParameterValue]:
        """The present value of each parameter, with ``profile`` and ``context`` as chosen by hand."""
        chosen = {PROFILE: self._adapter.adaptation.pinned, CONTEXT: self._contexts.chosen}
        return {name: chosen.get(name, parameter.value) for name, parameter in self._known.items()}

    async def set(self, values: Mapping[str, ParameterValue]) -> None:
        """Set parameters together.

        Raises:
            ConfigError: A value is invalid or a profile cannot be applied; nothing is changed.
            LocalProtocolError: The resource ends.
            PeerRefused: A context cannot be entered, or a node has not taken a value; no other value is changed.
        """
        wanted = {name: checked(name, value, self._known) for name, value in values.items()}
        async with self._lock:
            if self._updates is None:
                raise LocalProtocolError(f"resource {self._runtime.resource.name} ends")
            self._quiet = True  # published together at the end
            try:
                before, pinned = self._contexts.chosen, self._adapter.adaptation.pinned
                if (context := wanted.pop(CONTEXT, before)) != before:
                    await self._contexts.choose(str(context))
                try:
                    # A person who sets the profile alone gives it back what was set by hand.
                    alone = [*values] == [PROFILE]
                    await self._choose_profile(str(wanted.pop(PROFILE, pinned)), release=alone)
                    await self._actuation.set(wanted)
                except RmpaError:
                    if self._adapter.adaptation.pinned != pinned:
                        self._adapter.pin(pinned)
                    await self._contexts.choose(before)
                    raise
                await self._set_parameters(wanted)
            finally:
                self._quiet = False
                self.changed()

    def parameter_changed(self, parameter: Parameter) -> None:  # noqa: ARG002
        """Publish the configuration."""
        self.changed()

    def changed(self) -> None:
        """Publish the configuration if it has changed, and mirror it on the parameter server."""
        values = self.values
        if self._updates is None or self._quiet or values == self._published:
            return
        self._published = values
        self._updates.publish(config(values))
        if self._mirror is None or self._mirror.done():
            self._mirror = start_task(self._to_server(), "mirror parameters")

    async def _serve(self, request: Any) -> dict[str, object]:
        await self.set(reconfigure.read_config(request.config))
        return {"config": config(self.values)}

    async def _set_parameters(self, values: Mapping[str, ParameterValue]) -> None:
        """Set declared parameters; several are set while tasks are paused, so that no run sees only some of them."""
        if len(values) > 1:
            await self._tasks.pause(_HOLDER)
        try:
            for name, value in values.items():
                self._known[name].value = value
        finally:
            self._tasks.resume(_HOLDER)

    async def _choose_profile(self, profile: str, *, release: bool) -> None:
        loop, before = self._adapter.adaptation, self._adapter.adaptation.pinned
        released = release and self._actuation.release()
        if profile == before and (not profile or profile == loop.profile) and not released:
            return
        if released:
            await self._adapter.settled()  # one that is under way has the values by hand
        self._adapter.pin(profile, again=released)
        await self._adapter.settled()
        if not profile or profile == loop.profile:
            return
        scores = loop.explain(asyncio.get_running_loop().time())
        why = next((s.excluded for s in scores if s.profile == profile), "") or "another was taken"
        self._adapter.pin(before)
        await self._adapter.settled()
        raise ConfigError(f"profile {profile}", f"it could not be applied: {why}", "what was chosen before stays")

    async def _to_server(self) -> None:
        """Write changed values to the parameter server until all are written."""
        node, unknown = self._runtime.node, object()
        try:
            while todo := {n: v for n, v in self._published.items() if self._mirrored.get(n, unknown) != v}:
                for name, value in todo.items():
                    await node.set_param(f"{node.name}/{name}", value)
                    self._mirrored[name] = value
        except RmpaError as error:
            _log.debug("! %s: the parameter server: %s", node.name, error)
