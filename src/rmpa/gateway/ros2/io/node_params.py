"""The parameters of ROS 2's nodes, in the gateway's own tree of parameters, both ways."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any, Final, Protocol

from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.ros2.attachment import Ros2Attachment
from rmpa.gateway.ros2.params import EVENT_TYPE, EVENTS, ROOT, ParamTypes, flat, key_of
from rmpa.gateway.ros2.qos import Ros2Qos
from rmpa.gateway.ros2.tokens import EntityKind, data_key

if TYPE_CHECKING:
    from rmpa.gateway.ros2.io.own_nodes import OwnEndpoint
    from rmpa.gateway.ros2.io.part import Ros2Context
    from rmpa.gateway.zenoh_api import Declared, ZenohSample
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

_PORTION: Final = 100
"""Parameters that are asked for at once."""


class ParamTree(Protocol):
    """The gateway's own parameters."""

    async def read(self, key: str) -> XmlRpcValue:
        """The value of a parameter or namespace; ``None`` if there is none."""

    async def provide(self, key: str, value: XmlRpcValue) -> None:
        """Set a parameter; ``None`` deletes it."""


class NodeParams:
    """Holds the parameters of all nodes of ROS 2 below ``/ros2`` of the gateway, as they are there.

    What is set below ``/ros2`` here is set at its node; a value that the node refuses is put back.

    Args:
        context: What the parts share.
        types: The types of rcl_interfaces.
        tree: The gateway's own parameters.
    """

    def __init__(self, context: Ros2Context, types: ParamTypes, tree: ParamTree) -> None:
        self._context = context
        self._types = types
        self._tree = tree
        self._nodes: dict[str, dict[str, XmlRpcValue]] = {}
        """What is known of each node's parameters, by its name and theirs."""
        self._read_nodes: set[str] = set()
        """Nodes whose parameters were read: what differs then was set here."""
        self._callers: dict[str, OwnEndpoint] = {}
        self._listening: list[Declared | OwnEndpoint] = []
        self._sequence = 0
        self._lock = asyncio.Lock()
        context.spawn(self._look_for_changes())

    def appeared(self, node: str) -> None:
        """A node offers its parameters: read them."""
        if node in self._nodes:
            return
        if len(self._nodes) >= limits.ROS2_PARAM_NODES_MAX:
            self._context.say(f"parameters of {node}", f"those of {len(self._nodes)} nodes are here already")
            return
        if not self._context.crossing.incoming(SourceKind.SERVICE, node, "*", node).allowed:
            return
        self._nodes[node] = {}
        self._listen()
        self._context.spawn(self._read(node))

    def gone(self, node: str) -> None:
        """A node is gone: its parameters go too."""
        self._read_nodes.discard(node)
        if (known := self._nodes.pop(node, None)) is not None:
            self._context.say(f"parameters of {node}", "")
            for name in [name for name in self._callers if name.startswith(f"{node}/")]:
                self._callers.pop(name).close()
            self._context.spawn(self._forget(node, list(known)))

    def close(self) -> None:
        """Take back what was declared; the values stay until the gateway ends."""
        for each in (*self._listening, *self._callers.values()):
            each.close()

    def report(self) -> dict[str, int]:
        """The number of parameters of each node."""
        return {node: len(values) for node, values in self._nodes.items()}

    # --- from ROS 2 ------------------------------------------------------------------------------------------------

    def _listen(self) -> None:
        if self._listening:
            return
        context = self._context
        type_hash = self._types.event_hash()
        key = data_key(context.settings.ros2.domain, EVENTS, EVENT_TYPE, type_hash)
        endpoint = context.nodes.declare(
            context.nodes.own_name, EntityKind.SUBSCRIPTION, EVENTS, EVENT_TYPE, type_hash, Ros2Qos()
        )
        self._listening = [endpoint, context.session.subscribe(key, self._event)]

    def _event(self, sample: ZenohSample) -> None:
        try:
            event = self._types.read(EVENT_TYPE, sample.payload)
        except RmpaError as error:
            self._context.say(EVENTS, str(error))
            return
        if event.node in self._nodes:
            self._context.spawn(self._take(event))

    async def _take(self, event: Any) -> None:
        async with self._lock:
            for parameter in (*event.new_parameters, *event.changed_parameters):
                await self._store(event.node, parameter.name, self._types.plain(parameter.value))
            for parameter in event.deleted_parameters:
                await self._store(event.node, parameter.name, None)

    async def _read(self, node: str) -> None:
        """Read all parameters of a node; one that declares its services one by one may not answer at first."""
        again, longest = limits.ROS2_DESCRIBE_AGAIN
        async with self._lock:
            await self._tree.provide(ROOT + node, None)  # of a node of this name that was here before
        while node in self._nodes and node not in self._read_nodes:
            try:
                await self._read_once(node)
            except RmpaError as error:
                self._context.say(f"parameters of {node}", str(error))
                await asyncio.sleep(again)
                again = min(again * 2, longest)

    async def _read_once(self, node: str) -> None:
        answer = await self._call(node, "list_parameters", prefixes=[], depth=0)
        names = [str(name) for name in answer.result.names][: limits.ROS2_PARAMS_MAX]
        for first in range(0, len(names), _PORTION):
            asked = names[first : first + _PORTION]
            answer = await self._call(node, "get_parameters", names=asked)
            async with self._lock:
                for name, value in zip(asked, answer.values, strict=False):
                    await self._store(node, name, self._types.plain(value))
        if node in self._nodes:
            self._read_nodes.add(node)
            self._context.say(f"parameters of {node}", "")

    async def _store(self, node: str, name: str, value: XmlRpcValue) -> None:
        known = self._nodes.get(node)
        # Names such as qos_overrides./topic.depth cannot be in ROS 1's tree.
        if known is None or "/" in name or (value is None and name not in known):
            return
        try:
            await self._tree.provide(ROOT + node + key_of(name), value)
        except RmpaError as error:
            self._context.say(f"parameters of {node}", str(error))
            return
        if value is None:
            del known[name]
        else:
            known[name] = value

    async def _forget(self, node: str, names: list[str]) -> None:
        async with self._lock:
            if node not in self._nodes:  # it may be back
                for name in names:
                    await self._tree.provide(ROOT + node + key_of(name), None)

    # --- to ROS 2 --------------------------------------------------------------------------------------------------

    async def _look_for_changes(self) -> None:
        while True:
            await asyncio.sleep(limits.ROS2_PARAM_LOOK)
            try:
                await self.look()
            except RmpaError as error:
                self._context.say(f"parameters below {ROOT}", str(error))

    async def look(self) -> None:
        """Set at the nodes what was set here since the last look."""
        if not self._nodes:
            return
        async with self._lock:
            tree = await self._tree.read(ROOT)
            for node in sorted(self._read_nodes):
                found: XmlRpcValue = tree
                for part in node.strip("/").split("/"):
                    found = found.get(part) if isinstance(found, dict) else None
                values = flat(found) if isinstance(found, dict) else {}
                known = self._nodes.get(node, {})
                changed = {n: v for n, v in values.items() if n not in known or _differs(known[n], v)}
                inside = tuple(
                    f"{other[len(node) + 1 :]}/".replace("/", ".")
                    for other in self._nodes
                    if other.startswith(f"{node}/")
                )
                for name, value in changed.items():
                    if not name.startswith(inside):
                        await self._set(node, name, value)

    async def _set(self, node: str, name: str, value: XmlRpcValue) -> None:
        known = self._nodes.get(node, {})
        parameter = self._types.make("rcl_interfaces/msg/Parameter", name=name, value=self._types.value(value))
        reason = ""
        try:
            answer = await self._call(node, "set_parameters", parameters=[parameter])
            result = answer.results[0] if answer.results else None
            if result is None or not result.successful:
                reason = "it refuses" if result is None else str(result.reason) or "it refuses"
        except RmpaError as error:
            reason = str(error)
        subject = f"parameter {name} of {node}"
        if reason:
            self._context.say(subject, f"was set here, and is put back: {reason}")
            await self._tree.provide(ROOT + node + key_of(name), known.get(name))
        elif node in self._nodes:
            self._context.say(subject, "")
            known[name] = value

    async def _call(self, node: str, service: str, **fields: Any) -> Any:
        kind, type_hash = self._types.service(service)
        name = f"{node}/{service}"
        if name not in self._callers:
            nodes = self._context.nodes
            self._callers[name] = nodes.declare(nodes.own_name, EntityKind.CLIENT, name, kind, type_hash, Ros2Qos())
        caller = self._callers[name]
        self._sequence += 1
        answers = await self._context.session.get(
            caller.endpoint.key(),
            self._types.write(f"{kind}_Request", **fields),
            Ros2Attachment(self._sequence, time.time_ns(), caller.gid).serialize(),
            timeout=limits.ROS2_PARAM_TIMEOUT,
            all_complete=True,
        )
        for answer in answers:
            if answer.ok:
                return self._types.read(f"{kind}_Response", answer.payload)
        raise RemoteProtocolError(f"{name} gave no answer")


def _differs(one: XmlRpcValue, other: XmlRpcValue) -> bool:
    return repr(one) != repr(other)  # 1 and 1.0 are of other types, and nan is as it was
