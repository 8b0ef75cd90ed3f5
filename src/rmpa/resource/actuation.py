"""Sets the values that other nodes have for a resource's parameters (``Binding``), and follows what people set there.

A profile's values are set together: those of one node in one call, the nodes at the same time. What a node has
after that is read back from its reply. If one refuses, clips or does not answer, all nodes get their earlier values,
and the profile has failed with that as its reason.

A value that an operator sets at the node (rqt_reconfigure) stays: it is *by hand*, and so is one that is set at the
resource. Profiles leave such a parameter alone until a profile is chosen by hand or the choice is given back, or
until the operator sets what the profile wants. A node that has been started anew gets all values again.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import math
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.config.values import suggestion
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError
from rmpa.resource import limits
from rmpa.resource.declare import Binding, BindingKind, Parameter, ParameterValue
from rmpa.resource.runtime import Runtime, RuntimePart
from rmpa.ros.types.descriptor import CONFIG_TYPE, SERVICE_TYPE
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType, Plain

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.resource.decision import Profile
    from rmpa.resource.processes import Processes
    from rmpa.ros.node.endpoints import Received, Subscriber

_log = logging.getLogger(__name__)
_DYNAMIC, _PRIVATE, _ARGUMENT = BindingKind
# Values of floats that differ by less are the same: nodes convert them.
_TOLERANCE: Final = 1e-6
# The type of the values in each list of a ``Config``.
_LISTS: Final = {"bools": bool, "ints": int, "strs": str, "doubles": float}


def same(one: object, other: object) -> bool:
    """Whether two values of a parameter are the same; numbers of any type within a tolerance."""
    if isinstance(one, int | float) and isinstance(other, int | float):
        return math.isclose(one, other, rel_tol=_TOLERANCE, abs_tol=_TOLERANCE * _TOLERANCE)
    return one == other


def _fit(value: ParameterValue, present: ParameterValue) -> ParameterValue:
    """A number in the type that the node has."""
    if isinstance(value, str) or isinstance(present, str) or type(present)(value) != value:
        return value
    return type(present)(value)


def lists(values: Mapping[str, ParameterValue]) -> dict[str, Plain]:
    """Make the plain values of a ``Config`` that asks a server for some values; the others stay."""
    return {
        key: [{"name": name, "value": value} for name, value in values.items() if type(value) is kind]
        for key, kind in _LISTS.items()
    }


def read_config(message: Any) -> dict[str, ParameterValue]:
    """The values of a ``Config`` message by parameter; groups are ignored, since there is only one.

    Raises:
        ConfigError: The message has a parameter twice.
    """
    found: dict[str, ParameterValue] = {}
    for key, kind in _LISTS.items():
        for pair in getattr(message, key):
            name = str(pair.name)
            if name in found:
                raise ConfigError(f"parameter {name[:80]}", "it is given twice", "say it once")
            found[name] = kind(pair.value)
    return found


class Actuation(RuntimePart):
    """The bound parameters of one resource, and the nodes that profiles need; must be started before the adapter.

    Args:
        runtime: The runtime of the resource.
        processes: Starts, ends and restarts nodes.
    """

    # More than 12 fields: what is wanted, and what is known of the nodes.
    def __init__(self, runtime: Runtime, processes: Processes) -> None:
        super().__init__(runtime)
        self._processes = processes
        parameters, nodes = runtime.resource.parameters, runtime.resource.nodes
        self._bound = runtime.resource.bound
        # Values that people set, by parameter; may be set before ``start``.
        self.by_hand = {name: parameters[name].value for name in self._bound if parameters[name].given}
        # The parameters that some profile sets.
        self._profiled = {name for one in runtime.resource.profiles.values() for name in one.sets}
        # What the profile that runs sets.
        self._wanted: dict[str, ParameterValue] = {}
        # What the nodes have, by parameter, as it was read last.
        self._known: dict[str, ParameterValue] = {}
        for name, binding in self._bound.items():
            given = dict(text.partition(":=")[::2] for text in nodes[binding.node].args)
            if binding.kind is _ARGUMENT and binding.name in given:
                with contextlib.suppress(msgspec.ValidationError):
                    kind = type(parameters[name].default)
                    self._known[name] = msgspec.convert(given[binding.name], kind, strict=False)
        # By node: its whole configuration, whether it has come, and when it came or was set last.
        self._configs: dict[str, dict[str, ParameterValue]] = {}
        self._heard = {one.node: asyncio.Event() for one in self._bound.values() if one.kind is _DYNAMIC}
        self._touched: dict[str, float] = {}
        self._updates: dict[str, Subscriber] = {}
        # The header of each node's connection; one that is new means that the node may have been started anew.
        self._headers: dict[str, Mapping[str, str]] = {}
        self._fresh: set[str] = set()
        self._judging: set[str] = set()
        self._lock = asyncio.Lock()

    async def start(self) -> None:
        """Follow the values of the nodes."""
        node, nodes = self._runtime.node, self._runtime.resource.nodes
        if self._heard:
            self._service = await asyncio.to_thread(ServiceType, SERVICE_TYPE)
        for key in self._heard:
            self._updates[key] = await node.subscribe(
                f"{nodes[key].server or nodes[key].name}/parameter_updates",
                MessageType(CONFIG_TYPE),
                functools.partial(self._configured, key),
            )
        for name, binding in self._bound.items():
            if binding.kind is _PRIVATE:
                place = self._place(binding)
                if not binding.restart:
                    await node.follow_param(place, functools.partial(self._param_set, name))
                value: Any = await node.get_param(place, default=None)
                if isinstance(value, bool | int | float | str):
                    self._known[name] = value

    async def apply(self, profile: Profile) -> None:
        """Have the profile's nodes run, then set its values, except those by hand.

        Raises:
            PeerRefused: A node does not run, or has not taken a value; then all have their earlier values.
        """
        async with self._lock:
            wanted = {name: value for name, value in profile.sets.items() if name in self._bound}
            await self._run_nodes(profile, wanted | self.by_hand)
            running = {name for name, one in self._bound.items() if self._processes.pid(one.node) is not None}
            by_hand = {name: value for name, value in self.by_hand.items() if name in running}
            try:
                await self._set(by_hand)
            except PeerRefused as error:  # the node has changed since; that must not bar all profiles
                _log.warning("! %s: no longer by hand: %s [resource-trouble]", self._runtime.node.name, error)
                self.release()
            await self._set({name: value for name, value in wanted.items() if name not in self.by_hand})
            self._wanted = wanted

    async def set(self, values: Mapping[str, ParameterValue]) -> None:
        """Set values by hand, at their nodes; parameters that no node has are left out.

        Raises:
            PeerRefused: A node has not taken a value; then all have their earlier values.
        """
        bound = {name: value for name, value in values.items() if name in self._bound}
        if not bound:
            return
        async with self._lock:
            await self._set(bound)
        for name, value in bound.items():
            self._turned(name, value, here=True)

    def release(self) -> bool:
        """Give all values by hand back to the profiles; the caller applies the profile again if there was one."""
        had = bool(self.by_hand)
        self.by_hand.clear()
        return had

    def parameter_changed(self, parameter: Parameter) -> None:
        """Set at its node what the user's code has set."""
        if parameter.name in self._known and not same(self._known[parameter.name], parameter.value):
            self._work.start(self._follow(parameter), f"set {parameter.name}")

    async def _follow(self, parameter: Parameter) -> None:
        async with self._lock:
            if same(self._known[parameter.name], parameter.value):
                return  # set meanwhile
            try:
                await self._set({parameter.name: parameter.value})
            except RmpaError as error:
                _log.warning("! %s: %s [resource-trouble]", self._runtime.node.name, error)
                self._show(parameter.name)

    async def _run_nodes(self, profile: Profile, values: Mapping[str, ParameterValue]) -> None:
        """Have exactly the profile's nodes run; one that is started for it is started with its values at once."""
        absent = {key for key in self._runtime.resource.nodes if self._processes.pid(key) is None}
        for name, value in values.items():
            binding = self._bound[name]
            if binding.kind is _PRIVATE and binding.node in absent:
                await self._set_private(name, value)
        for key in absent:
            if self._differing(key, values, _ARGUMENT):
                await self._restart(key, values)  # before it is needed, it only takes the arguments
        await self._processes.require(profile.nodes)

    async def _set(self, values: Mapping[str, ParameterValue]) -> None:
        """Set values at their nodes, all or none."""
        nodes: dict[str, dict[str, ParameterValue]] = {}
        for name, value in values.items():
            nodes.setdefault(self._bound[name].node, {})[name] = value
        for outcome in await asyncio.gather(*map(self._read, nodes), return_exceptions=True):
            if isinstance(outcome, BaseException):
                raise outcome
        parameters = self._runtime.resource.parameters
        defaults = {name: parameters[name].default for name, one in self._bound.items() if one.kind is _ARGUMENT}
        before = defaults | self._known
        todo = {key: wanted for key, wanted in nodes.items() if self._differing(key, wanted)}
        outcomes = await asyncio.gather(*(self._set_node(*each) for each in todo.items()), return_exceptions=True)
        if failed := next((one for one in outcomes if isinstance(one, BaseException)), None):
            earlier = {key: {name: before[name] for name in wanted if name in before} for key, wanted in todo.items()}
            undone = await asyncio.gather(
                *(self._set_node(*each) for each in earlier.items()), return_exceptions=True
            )
            for error in undone:
                if isinstance(error, BaseException):
                    _log.warning("! %s: not undone: %s [resource-trouble]", self._runtime.node.name, error)
            for name in values.keys() - before.keys():
                if self._known.pop(name, None) is not None and self._bound[name].kind is _PRIVATE:
                    await self._runtime.node.delete_param(self._place(self._bound[name]))
        for name in values:
            self._show(name)
        if failed:
            raise failed

    def _differing(
        self, key: str, values: Mapping[str, ParameterValue], kind: BindingKind | None = None
    ) -> dict[str, ParameterValue]:
        """Those of the values that a node does not have."""
        return {
            name: value
            for name, value in values.items()
            for binding in (self._bound[name],)
            if binding.node == key and kind in (None, binding.kind) and not same(self._known.get(name), value)
        }

    async def _set_node(self, key: str, values: Mapping[str, ParameterValue]) -> None:
        """Set the values of one node, and restart it if it reads one of them at its start only."""
        differing = self._differing(key, values)
        for name, value in differing.items():
            if self._bound[name].kind is _PRIVATE:
                await self._set_private(name, value)
        if any(self._bound[name].restart for name in differing):
            await self._restart(key, values)
            # A node that has been started anew has its own values.
            values = {n: v for n, v in (self._wanted | self.by_hand).items() if self._bound[n].node == key} | {
                **values
            }
            await self._read(key)
        if dynamic := self._differing(key, values, _DYNAMIC):
            await self._reconfigure(key, dynamic)

    async def _set_private(self, name: str, value: ParameterValue) -> None:
        await self._runtime.node.set_param(self._place(self._bound[name]), value)
        self._known[name] = value

    async def _restart(self, key: str, values: Mapping[str, ParameterValue]) -> None:
        """Restart a node with the launch arguments that it has and those of the values."""
        known = {n: v for n, v in (self._known | {**values}).items() if self._bound[n].node == key}
        arguments = {name: value for name, value in known.items() if self._bound[name].kind is _ARGUMENT}
        if key in self._heard:
            self._heard[key].clear()
        texts = {self._bound[n].name: str(v).lower() if v in (True, False) else str(v) for n, v in arguments.items()}
        self._known |= arguments  # also if that fails: what is undone differs then
        await self._processes.restart(key, args=texts)

    async def _read(self, key: str) -> None:
        """Wait until the dynamic parameters of a node are known.

        Raises:
            PeerRefused: It does not say them in time.
        """
        if key not in self._heard:
            return
        limit = self._runtime.resource.settings.apply_timeout
        if not self._updates[key].publishers:
            self._heard[key].clear()  # that was of a node that has ended
        try:
            async with asyncio.timeout(limit):
                await self._heard[key].wait()
        except TimeoutError:
            text = f"no parameter_updates within {limit:g} s"
            raise PeerRefused(self._where(key), text, "does it run, and has it dynamic_reconfigure?") from None
        for name, binding in self._bound.items():
            if binding.node == key and binding.kind is _DYNAMIC and binding.name in self._configs[key]:
                self._known[name] = self._configs[key][binding.name]

    async def _reconfigure(self, key: str, values: Mapping[str, ParameterValue]) -> None:
        """Set dynamic parameters of one node by one call, and compare its reply."""
        present, limit = self._configs[key], self._runtime.resource.settings.apply_timeout
        asked: dict[str, ParameterValue] = {}
        for name, value in values.items():
            there = self._bound[name].name
            if there not in present:
                remedy = suggestion(there, present, f"it has {', '.join(present)}")
                raise PeerRefused(self._where(key), f"{name}: it has no dynamic parameter {there}", remedy)
            asked[there] = _fit(value, present[there])
        node = self._runtime.resource.nodes[key]
        service = f"{node.server or node.name}/set_parameters"
        self._touch(key)
        try:
            async with asyncio.timeout(limit):
                reply = await self._runtime.node.call_service(service, self._service, {"config": lists(asked)}, limit)
            got = read_config(reply.config)
        except (TimeoutError, RmpaError) as error:
            self._fresh.add(key)  # what it does of this later is no operator's act
            what = ", ".join(f"{name} = {value}" for name, value in values.items())
            why = error.reason if isinstance(error, PeerRefused) else str(error) or f"no answer within {limit:g} s"
            raise PeerRefused(self._where(key), f"{what}: {why}") from error
        self._touch(key)
        self._configs[key] = got
        wrong = []
        for name, value in values.items():
            there = self._bound[name].name
            self._known[name] = got.get(there, present[there])
            if not same(got.get(there), value):
                wrong.append(f"{name}: wanted {value}, got {got.get(there, 'nothing')}")
        if wrong:
            raise PeerRefused(self._where(key), "; ".join(wrong))

    def _where(self, key: str) -> str:
        return f"node {self._runtime.resource.nodes[key].name}"

    def _place(self, binding: Binding) -> str:
        """The key of a private parameter on the parameter server."""
        return f"{self._runtime.resource.nodes[binding.node].name}/{binding.name}"

    def _touch(self, key: str) -> None:
        self._touched[key] = asyncio.get_running_loop().time()

    def _configured(self, key: str, message: Received) -> None:
        """A node has said its configuration: judge it when it is quiet, that of a new connection at once."""
        self._configs[key] = read_config(message.message)
        self._heard[key].set()
        self._touch(key)
        if self._headers.get(key) is not message.header:
            self._headers[key] = message.header
            self._fresh.add(key)
            self._work.start(self._greet(key), f"first configuration of {key}")
        elif key not in self._judging:
            self._judging.add(key)
            self._work.start(self._judge(key), f"configuration of {key}")

    async def _judge(self, key: str) -> None:
        """Take over what an operator has changed, when the node is quiet."""
        loop, quiet = asyncio.get_running_loop(), limits.KNOB_QUIET
        while True:
            await asyncio.sleep(quiet)
            async with self._lock:
                if loop.time() - self._touched[key] >= quiet * 0.9:
                    self._judging.discard(key)
                    await self._take_over(key)
                    return

    async def _greet(self, key: str) -> None:
        async with self._lock:
            await self._take_over(key)

    async def _take_over(self, key: str) -> None:
        """Take over what has changed at a node, or give a node that is new what is wanted of it."""
        config, fresh = self._configs[key], key in self._fresh
        self._fresh.discard(key)
        dynamic = {n: b for n, b in self._bound.items() if b.node == key and b.kind is _DYNAMIC}
        wanted = {name: value for name, value in (self._wanted | self.by_hand).items() if name in dynamic}
        for name, binding in dynamic.items():
            value = config.get(binding.name)
            if value is None or (not fresh and same(self._known.get(name), value)):
                continue
            self._known[name] = value
            if not fresh:
                self._turned(name, value)
            if not fresh or name not in self._profiled | wanted.keys():
                self._show(name)
        if fresh and wanted:
            try:
                await self._set(wanted)
            except RmpaError as error:
                _log.warning("! %s: %s [resource-trouble]", self._runtime.node.name, error)

    def _param_set(self, name: str, _key: str, value: object) -> None:
        """A private parameter has been set by another node."""
        if isinstance(value, bool | int | float | str) and not same(self._known.get(name), value):
            self._known[name] = value
            self._show(name)
            self._turned(name, value)

    def _show(self, name: str) -> None:
        """Have the resource's parameter the value that the node has, if that is known and valid."""
        parameter = self._runtime.resource.parameters[name]
        value = self._known.get(name, parameter.value)
        try:
            parameter.value = _fit(value, parameter.default)
        except ConfigError as error:
            _log.warning("! %s: node has another value: %s [invalid-value]", self._runtime.node.name, error)

    def _turned(self, name: str, value: ParameterValue, *, here: bool = False) -> None:
        """Note what a person has set; ``here``: at the resource, so that a restarted node gets it again."""
        before = self.by_hand.pop(name, None)
        kept = here or before is not None or name in self._profiled
        if kept and not same(self._wanted.get(name), value):
            self.by_hand[name] = _fit(value, self._runtime.resource.parameters[name].default)
        if not same(before, self.by_hand.get(name)):
            text = f"{value} by hand; profiles leave it alone" if name in self.by_hand else "no longer by hand"
            _log.info("= %s: parameter %s: %s", self._runtime.node.name, name, text)
            self._runtime.changed()
