"""Serves a resource's configuration as dynamic_reconfigure does: ``set_parameters`` and its two latched topics.

Its values are mirrored at the parameter server below the resource's node, and taken from there at the start, so that
a launch file's or ``rmpa param set``'s count.
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
from rmpa.ros.types.messages import MessageType
from rmpa.ros.types.service_types import ServiceType

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.resource.decide.adaptation import Action
    from rmpa.resource.declare.resource import Parameter, ParameterValue
    from rmpa.resource.run.adapter import Adapter
    from rmpa.resource.run.contexts import Contexts
    from rmpa.resource.run.runtime import Runtime
    from rmpa.resource.run.tasks import Tasks
    from rmpa.ros.node.topics import Publisher

_WHO: Final = "configuration"
_log = logging.getLogger(__name__)
_MIRROR = 1.0
"""Seconds that an ending resource waits for the parameter server."""


class Reconfigure(RuntimePart):
    """The configuration of one resource; to be started behind the other parts, and ``before`` in front of them.

    Args:
        runtime: Of the resource.
        tasks: Paused while several parameters are set.
        adapter: Takes a profile that is chosen by hand.
        contexts: Take a context that is.
    """

    def __init__(self, runtime: Runtime, tasks: Tasks, adapter: Adapter, contexts: Contexts) -> None:
        self._runtime = runtime
        self._tasks = tasks
        self._adapter = adapter
        self._contexts = contexts
        self._known = entries(runtime.resource)
        self._updates: Publisher | None = None
        self._said: Mapping[str, ParameterValue] = {}
        self._mirrored: dict[str, ParameterValue] = {}
        self._mirror: asyncio.Task[None] | None = None
        self._quiet = False
        self._one = asyncio.Lock()

    @property
    def before(self) -> RuntimePart:
        """The part that takes what the parameter server holds, before anything runs."""
        return _FromServer(self)

    async def start(self) -> None:
        """Serve."""
        node = self._runtime.node
        described = await node.advertise(
            f"{node.name}/parameter_descriptions", MessageType(DESCRIPTION_TYPE), latch=True
        )
        described.publish(described.make(description(self._known)))
        self._updates = await node.advertise(f"{node.name}/parameter_updates", MessageType(CONFIG_TYPE), latch=True)
        self._adapter.listeners.append(self._acted)
        self._contexts.listeners.append(self.say)
        self.say()
        kind = await asyncio.to_thread(ServiceType, SERVICE_TYPE)  # reads our file of definitions
        await node.advertise_service(f"{node.name}/set_parameters", kind, self._asked)

    async def close(self) -> None:
        """Change nothing any more."""
        self._updates = None
        if self._mirror is not None:
            # Who starts next on this core takes what stands there.
            await asyncio.wait([self._mirror], timeout=_MIRROR)
            self._mirror.cancel()
            await asyncio.wait([self._mirror])

    @property
    def values(self) -> dict[str, ParameterValue]:
        """What each parameter is at present."""
        found: dict[str, Any] = {
            name: parameter.value for name, parameter in self._runtime.resource.parameters.items()
        }
        found[PROFILE] = self._adapter.loop.pinned
        if CONTEXT in self._known:
            found[CONTEXT] = self._contexts.chosen
        return found

    async def set(self, values: Mapping[str, ParameterValue]) -> None:
        """Set parameters together.

        Raises:
            ConfigError: One of them cannot be, or the profile not be applied; nothing is changed then.
            PeerRefused: The context could not begin; likewise.
        """
        wanted = checked(values, self._known, self._runtime.resource.parameters)
        async with self._one:
            if self._updates is None:
                raise LocalProtocolError(f"resource {self._runtime.resource.name} ends")
            self._quiet = True  # what is set together is said together
            try:
                before = self._contexts.chosen
                if wanted.get(CONTEXT, before) != before:
                    await self._contexts.choose(str(wanted[CONTEXT]))
                try:
                    await self._choose(str(wanted.get(PROFILE, self._adapter.loop.pinned)))
                except RmpaError:
                    await self._contexts.choose(before)
                    raise
                await self._set_parameters({n: v for n, v in wanted.items() if n not in (PROFILE, CONTEXT)})
            finally:
                self._quiet = False
                self.say()

    def parameter_changed(self, parameter: Parameter) -> None:  # noqa: ARG002 - all are said together
        """Say it, whoever changed it."""
        self.say()

    def say(self) -> None:
        """Publish the configuration if it is another one, and mirror it at the parameter server."""
        values = self.values
        if self._updates is None or self._quiet or values == self._said:
            return
        self._said = values
        self._updates.publish(self._updates.make(config(values, self._known)))
        if self._mirror is None or self._mirror.done():
            self._mirror = asyncio.get_running_loop().create_task(self._to_server(), name="mirror parameters")

    # --- inside -------------------------------------------------------------------------------------------------

    async def _asked(self, request: Any) -> dict[str, object]:
        await self.set(read_config(request.config))
        return {"config": config(self.values, self._known)}

    async def _set_parameters(self, values: Mapping[str, ParameterValue]) -> None:
        """Set declared parameters; several of them between two runs of the tasks, so that none sees half of them."""
        if len(values) > 1:
            await self._tasks.pause(_WHO)
        try:
            for name, value in values.items():
                self._runtime.set_parameter(name, value)
        finally:
            if len(values) > 1:
                self._tasks.resume(_WHO)

    async def _choose(self, profile: str) -> None:
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

    def _acted(self, _action: Action) -> None:
        self.say()

    async def _to_server(self) -> None:
        """Write what has changed, until nothing has."""
        node = self._runtime.node
        try:
            while True:
                todo = {name: v for name, v in self._said.items() if self._mirrored.get(name) != v}
                todo |= {name: v for name, v in self._said.items() if name not in self._mirrored}
                if not todo:
                    return
                for name, value in todo.items():
                    await node.set_param(f"{node.name}/{name}", value)
                    self._mirrored[name] = value
        except RmpaError as error:
            _log.debug("! %s: the parameter server: %s", node.name, error)

    async def load(self) -> None:
        """Take what the parameter server holds."""
        node, resource = self._runtime.node, self._runtime.resource
        found = await node.get_param(node.name, default={})
        if not isinstance(found, dict):
            return
        taken, problems = from_server(found, self._known, resource.parameters)
        for problem in problems:
            _log.warning("! %s: the parameter server: %s; it is left out", node.name, problem)
        for name, value in taken.items():
            if name == PROFILE:
                self._adapter.chosen = str(value)
            elif name == CONTEXT:
                self._contexts.chosen = str(value)
            elif not resource.parameters[name].given:
                self._runtime.set_parameter(name, value)


class _FromServer(RuntimePart):
    """Takes the values of the parameter server at the start."""

    def __init__(self, whole: Reconfigure) -> None:
        self._whole = whole

    async def start(self) -> None:
        """Do it."""
        await self._whole.load()
