"""A resource as a server of dynamic_reconfigure (wiki.ros.org/dynamic_reconfigure).

Converts a resource's configuration to dynamic_reconfigure's messages and back (wiki.ros.org/dynamic_reconfigure).

Pure functions between parameters and the plain values of ``dynamic_reconfigure/Config`` and ``ConfigDescription``. A
number out of range is clipped, as by dynamic_reconfigure's own servers; any other invalid value is an error.

Two parameters are not declared by the user: ``profile`` (empty: the resource decides) and, where there are contexts,
``context`` (empty: the rules decide).
"""

from __future__ import annotations

import asyncio
import logging
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, LocalProtocolError, RmpaError
from rmpa.resource.declare.parameters import INT_MAX, INT_MIN, Parameter
from rmpa.resource.run.runtime import RuntimePart
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rmpa.resource.declare.parameters import ParameterValue
    from rmpa.resource.declare.resource import Resource
    from rmpa.resource.run.adapter import Adapter
    from rmpa.resource.run.contexts import Contexts
    from rmpa.resource.run.runtime import Runtime
    from rmpa.resource.run.tasks import Tasks
    from rmpa.ros.node.endpoints import Publisher
    from rmpa.ros.types.messages import Plain

CONFIG_TYPE: Final = "dynamic_reconfigure/Config"
DESCRIPTION_TYPE: Final = "dynamic_reconfigure/ConfigDescription"
SERVICE_TYPE: Final = "dynamic_reconfigure/Reconfigure"
PROFILE: Final = "profile"
CONTEXT: Final = "context"
AUTOMATIC: Final = "automatic"
"""Name that enumerations show for an empty ``profile`` or ``context``."""
_LISTS: Final = {"bool": "bools", "int": "ints", "str": "strs", "double": "doubles"}
_GROUP: Final[dict[str, Plain]] = {"name": "Default", "id": 0, "parent": 0}
"""The group of all parameters: the one that every server has."""


@dataclass(frozen=True, slots=True)
class EnumChoice:
    """One value of an enumeration, with its name."""

    name: str
    value: ParameterValue
    description: str = ""


@dataclass(frozen=True, slots=True)
class ReconfigureEntry:
    """One parameter as dynamic_reconfigure's tools see it.

    Args:
        name: The parameter's name, a ROS base name.
        kind: ``bool``, ``int``, ``double`` or ``str``.
        default: The default value.
        low: The least value of a number; without a declared bound ``-inf``, or the least 32-bit integer.
        high: The greatest value of a number; without a declared bound ``inf``, or the greatest 32-bit integer.
        description: A text for people, with the unit.
        choices: The values of an enumeration; empty for other parameters.
    """

    name: str
    kind: str
    default: ParameterValue
    low: float = -math.inf
    high: float = math.inf
    description: str = ""
    choices: tuple[EnumChoice, ...] = ()


def entries(resource: Resource) -> dict[str, ReconfigureEntry]:
    """All parameters of a resource: the declared ones in order, then ``profile`` and ``context``."""
    found = {name: _entry(parameter) for name, parameter in resource.parameters.items()}
    profiles = [EnumChoice(p.profile.name, p.profile.name, p.profile.description) for p in resource.profiles.values()]
    found[PROFILE] = _pseudo(PROFILE, "the profile to run; empty: the resource decides", profiles)
    if resource.contexts:
        contexts = [EnumChoice(c.name, c.name, c.when) for c in resource.contexts.values()]
        found[CONTEXT] = _pseudo(CONTEXT, "the context to be in; empty: its rules decide", contexts)
    return found


def _entry(parameter: Parameter) -> ReconfigureEntry:
    text = parameter.description
    if parameter.unit:
        text = f"{text} [{parameter.unit}]".lstrip()
    choices = tuple(EnumChoice(str(value), value) for value in parameter.choices)
    low, high = parameter.bounds
    return ReconfigureEntry(parameter.name, parameter.type, parameter.default, low, high, text, choices)


def _pseudo(name: str, text: str, choices: Sequence[EnumChoice]) -> ReconfigureEntry:
    free = AUTOMATIC
    while any(choice.name.lower() == free for choice in choices):
        free = f"({free})"
    return ReconfigureEntry(
        name, "str", "", description=text, choices=(EnumChoice(free, "", "not chosen by hand"), *choices)
    )


def config(values: Mapping[str, ParameterValue], known: Mapping[str, ReconfigureEntry]) -> dict[str, Plain]:
    """Make the plain values of a ``Config`` message.

    Args:
        values: Values by parameter.
        known: The entries of the parameters, by name.
    """
    made: dict[str, Any] = {key: [] for key in _LISTS.values()}
    for name, value in values.items():
        made[_LISTS[known[name].kind]].append({"name": name, "value": value})
    made["groups"] = [{**_GROUP, "state": True}]
    return made


def description(known: Mapping[str, ReconfigureEntry]) -> dict[str, Plain]:
    """Make the plain values of a ``ConfigDescription`` message from the entries of the parameters."""
    parameters: list[Plain] = [
        {
            "name": entry.name,
            "type": entry.kind,
            "level": 0,
            "description": entry.description,
            "edit_method": _edit_method(entry),
        }
        for entry in known.values()
    ]
    return {
        "groups": [{**_GROUP, "type": "", "parameters": parameters}],
        "min": config({name: _bound(entry, low=True) for name, entry in known.items()}, known),
        "max": config({name: _bound(entry, low=False) for name, entry in known.items()}, known),
        "dflt": config({name: entry.default for name, entry in known.items()}, known),
    }


def _bound(entry: ReconfigureEntry, *, low: bool) -> ParameterValue:
    if entry.kind == "bool":
        return not low
    if entry.kind == "str":
        return ""
    value = entry.low if low else entry.high
    if entry.kind == "double":
        return float(value)
    # An integer's bound may be a fraction: take the nearest integer within it.
    return max(INT_MIN, min(INT_MAX, math.ceil(value) if low else math.floor(value)))


def _edit_method(entry: ReconfigureEntry) -> str:
    """The enumeration as clients expect it: a Python expression, which ``repr`` makes safe to evaluate."""
    if not entry.choices:
        return ""
    enum = [
        {
            "name": choice.name,
            "type": entry.kind,
            "value": choice.value,
            "description": choice.description,
            "srcline": 0,
            "srcfile": "",
            "ctype": {"str": "std::string"}.get(entry.kind, entry.kind),
            "cconsttype": "const char * const" if entry.kind == "str" else f"const {entry.kind}",
        }
        for choice in entry.choices
    ]
    return repr({"enum": enum, "enum_description": entry.description})


def read_config(message: Any) -> dict[str, ParameterValue]:
    """The values of a ``Config`` message by parameter; groups are ignored, since there is only one.

    Raises:
        ConfigError: The message has a parameter twice.
    """
    found: dict[str, ParameterValue] = {}
    kinds = {"bools": bool, "ints": int, "strs": str, "doubles": float}
    for key, kind in kinds.items():
        for pair in getattr(message, key):
            name = str(pair.name)
            if name in found:
                raise ConfigError(f"parameter {name[:80]}", "it is given twice", "say it once")
            found[name] = kind(pair.value)
    return found


def checked(
    values: Mapping[str, ParameterValue], known: Mapping[str, ReconfigureEntry], parameters: Mapping[str, Parameter]
) -> dict[str, ParameterValue]:
    """Check the values that a client sets, and clip numbers to their bounds.

    Raises:
        ConfigError: A name is unknown or a value is invalid; the first such error.
    """
    return {name: _checked(name, value, known, parameters) for name, value in values.items()}


def _checked(
    name: str, value: ParameterValue, known: Mapping[str, ReconfigureEntry], parameters: Mapping[str, Parameter]
) -> ParameterValue:
    if name not in known:
        near = did_you_mean(name, known)
        remedy = f"did you mean {near}?" if near else f"there are {', '.join(known)}"
        raise ConfigError(f"parameter {name[:80]}", "there is none of this name", remedy)
    entry = known[name]
    if name in parameters:
        return parameters[name].check(_clipped(value, entry))
    if not isinstance(value, str):
        raise ConfigError(name, f"{value!r} is no text", f"it is one of {_named(entry)}")
    return choose(value, entry)


def choose(value: str, entry: ReconfigureEntry) -> str:
    """Find the value of a ``profile`` or ``context`` by the value itself, or by its shown name in any case.

    Raises:
        ConfigError: The enumeration has no such value.
    """
    for choice in entry.choices:
        if value == choice.value or value.lower() == choice.name.lower():
            return str(choice.value)
    near = did_you_mean(value, (choice.name for choice in entry.choices))
    remedy = f"did you mean {near}?" if near else f"it is one of {_named(entry)}"
    raise ConfigError(entry.name, f"there is no {entry.name} {value[:80]!r}", remedy)


def _named(entry: ReconfigureEntry) -> str:
    return ", ".join(choice.name for choice in entry.choices)


def _clipped(value: ParameterValue, entry: ReconfigureEntry) -> ParameterValue:
    if isinstance(value, bool | str) or entry.kind not in ("int", "double") or entry.choices:
        return value
    # The bounds are converted to the parameter's type, since a float is no value of an int parameter.
    low, high = _bound(entry, low=True), _bound(entry, low=False)
    if value < float(low):
        return low
    return high if value > float(high) else value


def from_server(
    found: Mapping[str, Any], known: Mapping[str, ReconfigureEntry], parameters: Mapping[str, Parameter]
) -> tuple[dict[str, ParameterValue], list[str]]:
    """Read the parameter server's values at the start of a resource.

    Args:
        found: The members of the resource's namespace; members that are no parameters are ignored.
        known: The entries of all parameters, by name.
        parameters: The declared parameters, by name.

    Returns:
        The valid values by parameter, and a text about each invalid one.
    """
    taken: dict[str, ParameterValue] = {}
    problems: list[str] = []
    for name in known:
        if name in found:
            try:
                taken[name] = _checked(name, found[name], known, parameters)
            except ConfigError as error:
                problems.append(str(error))
    return taken, problems


# Serves a resource's configuration as dynamic_reconfigure does: ``set_parameters`` and its two latched topics.
#
# The values are mirrored on the parameter server, below the name of the resource's node. They are loaded from
# there at
# the start, so that values of a launch file or ``rmpa param set`` take effect.


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
