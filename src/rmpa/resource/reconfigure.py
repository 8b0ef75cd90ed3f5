"""A resource as a server of dynamic_reconfigure (wiki.ros.org/dynamic_reconfigure): its messages, topics and service.

A number out of range is clipped, as by dynamic_reconfigure's own servers; any other invalid value is an error. Two
parameters are not declared by the user: ``profile`` (empty: the resource decides) and, where there are contexts,
``context`` (empty: the rules decide).

The values are mirrored on the parameter server, below the name of the resource's node. They are loaded from there at
the start, so that values of a launch file or ``rmpa param set`` take effect.
"""

from __future__ import annotations

import asyncio
import logging
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from rmpa.config.values import suggestion
from rmpa.core.errors import ConfigError, LocalProtocolError, RmpaError
from rmpa.core.limits import INT32_MAX, INT32_MIN
from rmpa.resource.actuation import Actuation, lists, read_config
from rmpa.resource.declare import Parameter, ParameterValue
from rmpa.resource.runtime import Runtime, RuntimePart
from rmpa.ros.types.descriptor import CONFIG_TYPE, SERVICE_TYPE
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType, Plain
from rmpa.runtime.tasks import end_tasks, start_task

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rmpa.resource.adapter import Adapter
    from rmpa.resource.contexts import Contexts
    from rmpa.resource.resource import Resource
    from rmpa.resource.tasks import Tasks
    from rmpa.ros.node.endpoints import Publisher

_log = logging.getLogger(__name__)
DESCRIPTION_TYPE: Final = "dynamic_reconfigure/ConfigDescription"
PROFILE: Final = "profile"
CONTEXT: Final = "context"
# Name that enumerations show for an empty ``profile`` or ``context``.
AUTOMATIC: Final = "automatic"
# The group of all parameters: the one that every server has.
_GROUP: Final[dict[str, Plain]] = {"name": "Default", "id": 0, "parent": 0}
_HOLDER: Final = "configuration"
# Seconds that an ending resource waits for the parameter server.
_MIRROR_TIMEOUT: Final = 1.0


@dataclass(eq=False)
class ChoiceParameter(Parameter):
    """``profile`` or ``context``: one of the declared ones, or empty.

    Args:
        names: The name that tools show, and the description, by value.
    """

    names: dict[str, tuple[str, str]] = field(default_factory=dict)

    def check(self, value: ParameterValue) -> str:
        """Find the value by the value itself, or by its shown name in any case.

        Raises:
            ConfigError: The enumeration has no such value.
        """
        names = [name for name, _ in self.names.values()]
        listed = f"it is one of {', '.join(names)}"
        if not isinstance(value, str):
            raise ConfigError(self.name, f"{value!r} is no text", listed)
        for one, (name, _) in self.names.items():
            if value == one or value.lower() == name.lower():
                return one
        problem = f"there is no {self.name} {value[:80]!r}"
        raise ConfigError(self.name, problem, suggestion(value, names, listed))


def entries(resource: Resource) -> dict[str, Parameter]:
    """All parameters of a resource: the declared ones in order, then ``profile`` and ``context``."""
    found = dict(resource.parameters)
    profiles = ((one.name, one.description) for one in resource.profiles.values())
    found[PROFILE] = _choice(PROFILE, "the profile to run; empty: the resource decides", profiles)
    if resource.contexts:
        contexts = ((one.name, str(one.when or "")) for one in resource.contexts.values())
        found[CONTEXT] = _choice(CONTEXT, "the context to be in; empty: its rules decide", contexts)
    return found


def _choice(name: str, text: str, choices: Iterable[tuple[str, str]]) -> ChoiceParameter:
    names = {value: (value, description) for value, description in choices}
    free = AUTOMATIC
    while free in (value.lower() for value in names):
        free = f"({free})"
    return ChoiceParameter(name, "", description=text, names={"": (free, "not chosen by hand"), **names})


def config(values: Mapping[str, ParameterValue]) -> dict[str, Plain]:
    """Make the plain values of a ``Config`` with all values of a server, by parameter."""
    return lists(values) | {"groups": [{**_GROUP, "state": True}]}


def description(known: Mapping[str, Parameter]) -> dict[str, Plain]:
    """Make the plain values of a ``ConfigDescription`` message from all parameters."""
    parameters: list[Plain] = [
        {
            "name": one.name,
            "type": one.type,
            "level": 0,
            "description": f"{one.description} [{one.unit}]".lstrip() if one.unit else one.description,
            "edit_method": _edit_method(one),
        }
        for one in known.values()
    ]
    return {
        "groups": [{**_GROUP, "type": "", "parameters": parameters}],
        "min": config({name: _bound(one, low=True) for name, one in known.items()}),
        "max": config({name: _bound(one, low=False) for name, one in known.items()}),
        "dflt": config({name: one.default for name, one in known.items()}),
    }


def _bound(parameter: Parameter, *, low: bool) -> ParameterValue:
    if parameter.type == "bool":
        return not low
    if parameter.type == "str":
        return ""
    value = parameter.bounds[0 if low else 1]
    if parameter.type == "double":
        return float(value)
    # An integer's bound may be a fraction: take the nearest integer within it.
    return max(INT32_MIN, min(INT32_MAX, math.ceil(value) if low else math.floor(value)))


def _edit_method(parameter: Parameter) -> str:
    """The enumeration as clients expect it: a Python expression, which ``repr`` makes safe to evaluate."""
    names: dict[Any, tuple[str, str]] = {value: (str(value), "") for value in parameter.choices}
    if isinstance(parameter, ChoiceParameter):
        names = dict(parameter.names)
    kind = parameter.type
    enum = [
        {
            "name": name,
            "type": kind,
            "value": value,
            "description": text,
            "srcline": 0,
            "srcfile": "",
            "ctype": "std::string" if kind == "str" else kind,
            "cconsttype": "const char * const" if kind == "str" else f"const {kind}",
        }
        for value, (name, text) in names.items()
    ]
    return repr({"enum": enum, "enum_description": parameter.description}) if enum else ""


def checked(name: str, value: ParameterValue, known: Mapping[str, Parameter]) -> ParameterValue:
    """Check a value that a client sets, and clip a number to its bounds.

    Raises:
        ConfigError: The name is unknown or the value is invalid.
    """
    parameter = known.get(name)
    if parameter is None:
        remedy = suggestion(name, known, f"there are {', '.join(known)}")
        raise ConfigError(f"parameter {name[:80]}", "there is none of this name", remedy)
    number = parameter.type in ("int", "double") and not parameter.choices
    if number and isinstance(value, int | float) and not isinstance(value, bool):
        # The bounds are converted to the parameter's type, since a float is no value of an int parameter.
        low, high = _bound(parameter, low=True), _bound(parameter, low=False)
        value = low if value < float(low) else high if value > float(high) else value
    return parameter.check(value)


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
        super().__init__(runtime)
        self._tasks = tasks
        self._actuation = actuation
        self._adapter = adapter
        self._contexts = contexts
        self._known = entries(runtime.resource)
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
                self._adapter.adaptation.pinned = str(value)
            elif name == CONTEXT:
                self._contexts.chosen = str(value)
            elif not self._known[name].given and self._known[name].binding is None:
                self._known[name].value = value

    async def start(self) -> None:
        """Advertise the topics and the service."""
        node, kind = self._runtime.node, MessageType(DESCRIPTION_TYPE)
        described = await node.advertise(f"{node.name}/parameter_descriptions", kind, latch=True)
        described.publish(description(self._known))
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
        await self.set(read_config(request.config))
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
