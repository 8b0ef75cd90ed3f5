"""The parameters of one module, as those of a node of ROS 2."""

from __future__ import annotations

import secrets
import time
from typing import TYPE_CHECKING, Any

from rmpa.bridge.params import transfer
from rmpa.bridge.params.io.core import read_text, write_text
from rmpa.bridge.permission_gate import Needs
from rmpa.config.permission_rules import Access
from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.ros2.attachment import Ros2Attachment
from rmpa.gateway.ros2.graph import OWN_NAMESPACE
from rmpa.gateway.ros2.params import SERVICES, ParamTypes, key_of, listed, name_in_ros2
from rmpa.gateway.ros2.qos import Ros2Qos
from rmpa.gateway.ros2.tokens import EntityKind, data_key
from rmpa.gateway.sites.params import parameters_in

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Generator, Sequence

    from rmpa.gateway.ros2.io.own_nodes import OwnEndpoint
    from rmpa.gateway.ros2.io.part import Ros2Context
    from rmpa.gateway.zenoh_api import Declared, ZenohQuery
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

    AskModule = Callable[[str, str, dict[str, Any]], Awaitable[object]]
    """Asks a linked module: its name, one of ``bridge.params.transfer``'s requests, the arguments."""


_NEEDS = Needs(
    (Access.PARAM,),
    "each parameter, by the module that has it, of the gateway and of `ros2`",
    key="the services of `ros2 param`",
)


class ModuleParams:
    """Offers ``ros2 param``'s services for one module, by the node ``/rmpa/<module>``.

    The module itself decides what may be read and set, as for its peers.

    Args:
        context: What the parts share.
        types: The types of rcl_interfaces.
        module: The module's name.
        ask: Asks a linked module.
    """

    def __init__(self, context: Ros2Context, types: ParamTypes, module: str, ask: AskModule) -> None:
        self._context = context
        self._types = types
        self._module = module
        self._ask = ask
        self._declared: list[Declared | OwnEndpoint] = []
        node = OWN_NAMESPACE + module
        for service in SERVICES:
            kind, type_hash = types.service(service)
            name = f"{node}/{service}"
            key = data_key(context.settings.ros2.domain, name, kind, type_hash)
            queryable = context.session.queryable(key, self._taker(service, kind), _NEEDS)
            endpoint = context.nodes.declare(node, EntityKind.SERVICE, name, kind, type_hash, Ros2Qos())
            self._declared += (queryable, endpoint)

    def close(self) -> None:
        """Take the services back."""
        for each in self._declared:
            each.close()

    # --- inside ----------------------------------------------------------------------------------------------------

    def _taker(self, service: str, kind: str) -> Callable[[ZenohQuery], None]:
        return lambda query: self._context.spawn(self._answer(service, kind, query))

    async def _answer(self, service: str, kind: str, query: ZenohQuery) -> None:
        try:
            asked = Ros2Attachment.parse(query.attachment)
            request = self._types.read(f"{kind}_Request", query.payload)
            fields = await self._do(service, request)
            reply = self._types.write(f"{kind}_Response", **fields)
        except RmpaError as error:
            query.reply_error(str(error))
            return
        query.reply(query.key, reply, Ros2Attachment(asked.sequence, time.time_ns(), asked.gid).serialize())
        query.finish()

    async def _do(self, service: str, request: Any) -> dict[str, Any]:
        make = self._types.make
        match service:
            case "list_parameters":
                names, prefixes = listed(await self._names(), request.prefixes, int(request.depth))
                return {"result": make("rcl_interfaces/msg/ListParametersResult", names=names, prefixes=prefixes)}
            case "set_parameters":
                return {"results": [await self._set(each) for each in request.parameters]}
            case "set_parameters_atomically":
                return {"result": await self._set_all(request.parameters)}
        values = [self._types.value(await self._get(name)) for name in request.names]
        if service == "get_parameters":
            return {"values": values}
        if service == "get_parameter_types":
            import numpy as np  # noqa: PLC0415 - it takes 70 ms, and few gateways have ROS 2

            return {"types": np.array([each.type for each in values], np.uint8)}
        return {
            "descriptors": [
                make(
                    "rcl_interfaces/msg/ParameterDescriptor",
                    name=name,
                    type=value.type,
                    description="",
                    additional_constraints="",
                    read_only=False,
                    dynamic_typing=True,
                    floating_point_range=[],
                    integer_range=[],
                )
                for name, value in zip(request.names, values, strict=True)
            ]
        }

    def _crosses(self, key: str) -> bool:
        return self._context.crossing.outgoing(SourceKind.SERVICE, self._module, key, "*", "").allowed

    async def _names(self) -> list[str]:
        found = await read_text(await self._drive(transfer.reading(transfer.NAMES, {})))
        keys = [str(each) for each in found] if isinstance(found, list) else []
        return [name_in_ros2(key) for key in keys if self._crosses(key)]

    async def _get(self, name: str) -> XmlRpcValue:
        """A value; ``None`` for one that is missing or may not be read, as ROS 2 nodes answer."""
        key = key_of(name)
        if not self._crosses(key):
            return None
        try:
            value = await read_text(await self._drive(transfer.reading(transfer.GET, {"key": key})))
        except PeerRefused:
            return None
        return value if all(map(self._crosses, parameters_in(key, value))) else None

    async def _set(self, parameter: Any) -> Any:
        make, key = self._types.make, key_of(parameter.name)
        reason = ""
        try:
            if not self._crosses(key):
                raise RemoteProtocolError(f"a gateway.rule lets {key} not cross")
            value = self._types.plain(parameter.value)
            if value is None:
                await self._ask(self._module, transfer.DELETE, {"key": key})
            else:
                await self._drive(transfer.writing(key, await write_text(key, value), secrets.randbits(31)))
        except RmpaError as error:
            reason = str(error)
        return make("rcl_interfaces/msg/SetParametersResult", successful=not reason, reason=reason)

    async def _set_all(self, parameters: Sequence[Any]) -> Any:
        """Set one after another until one is refused; then put the others back, for ROS 1 has no transactions."""
        before = [(each, await self._get(each.name)) for each in parameters]
        done: list[tuple[Any, XmlRpcValue]] = []
        result = self._types.make("rcl_interfaces/msg/SetParametersResult", successful=True, reason="")
        for parameter, old in before:
            result = await self._set(parameter)
            if not result.successful:
                break
            done.append((parameter, old))
        else:
            return result
        for parameter, old in reversed(done):
            value = self._types.value(old)
            await self._set(self._types.make("rcl_interfaces/msg/Parameter", name=parameter.name, value=value))
        return result

    async def _drive(self, steps: Generator[transfer.Question, object, Any]) -> Any:
        try:
            question = next(steps)
            while True:
                question = steps.send(await self._ask(self._module, *question))
        except StopIteration as done:
            return done.value
