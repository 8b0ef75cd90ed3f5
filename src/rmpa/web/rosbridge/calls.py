"""Services that a client calls: those of rosapi are answered here, all others by the hub."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rmpa.core.errors import RmpaError
from rmpa.web.hub.requests import (
    CallService,
    CancelCall,
    DeleteParam,
    FindService,
    FindServices,
    ParamsChanged,
    ServiceFound,
    ServiceResult,
    SetParam,
)
from rmpa.web.rosbridge import limits
from rmpa.web.rosbridge.context import Style, check_count
from rmpa.web.rosbridge.encodings import Compression
from rmpa.web.rosbridge.protocol import Id, OpError, graph_name, type_name
from rmpa.web.rosbridge.rosapi import DeleteParameter, FindType, FindTypes, Rosapi, SetParameter, Todo
from rmpa.web.values.codec import MessageCodec, codec_for

if TYPE_CHECKING:
    from rmpa.web.hub.requests import Failed, Payload
    from rmpa.web.rosbridge import protocol
    from rmpa.web.rosbridge.context import SessionContext


@dataclass(slots=True)
class _Call:
    """A call without an answer; `service` is as the client writes it."""

    service: str
    name: str
    mid: Id
    style: Style
    arguments: Any = None
    timeout: float | None = None
    response: MessageCodec | None = None
    todo: Todo | None = None


class Calls:
    """All calls of a client that are open.

    Args:
        context: The session.
        rosapi: Answers the services of rosapi.
    """

    def __init__(self, context: SessionContext, rosapi: Rosapi) -> None:
        self._context = context
        self._rosapi = rosapi
        self._open: dict[int, _Call] = {}

    def call(self, op: protocol.RosbridgeCallService) -> None:
        """Begin a call; each ends with one ``service_response``, also if it fails, and with nothing beside it.

        A ``status`` beside it would be an error of its own to roslib and roslibpy, which have no handler for it.
        """
        # An old way to give an id: /service#id.
        spelling, mark, suffix = op.service.partition("#")
        mid = op.id if op.id is not None or not mark else suffix
        call = _Call(op.service[: limits.NAME_MAX], spelling, mid, Style(), op.args)
        try:
            call.style = Style.parse(op.compression, op.fragment_size)
            call.name, call.timeout = graph_name(spelling), _timeout(op.timeout)
            check_count(len(self._open), limits.CALLS_MAX, "open calls")
            if self._rosapi.offers(call.name):
                self._ask_rosapi(call)
            else:
                self._begin(call, type_name(op.type) if op.type else self._type_of(call.name))
        except RmpaError as error:
            self._fail(call, str(error))

    def _ask_rosapi(self, call: _Call) -> None:
        answer = self._rosapi.call(call.name, call.arguments)
        if isinstance(answer, dict):
            self._answer(call, answer)
            return
        call.todo = answer
        handle = self._keep(call)
        if isinstance(answer, SetParameter):
            self._context.ask(SetParam(handle, answer.name, answer.value))
        elif isinstance(answer, DeleteParameter):
            self._context.ask(DeleteParam(handle, answer.name))
        elif isinstance(answer, FindType):
            self._context.ask(FindService(handle, answer.service))
        else:
            self._context.ask(FindServices(handle))

    def _type_of(self, name: str) -> str:
        service = self._context.graph.services.get(name)
        return service.type if service is not None else ""

    def _begin(self, call: _Call, kind: str) -> None:
        if not kind:
            self._context.ask(FindService(self._keep(call), call.name))
            return
        service = self._context.types.service(kind)
        request = codec_for(service.request).write_arguments(call.arguments, self._context.ros_time_ns())
        if request.missing:
            fields = ", ".join(request.missing)
            self._context.status("warning", f"call_service {call.name}: not given: {fields}", call.mid)
        call.response = codec_for(service.response)
        call.arguments = None
        self._context.ask(CallService(self._keep(call), call.name, kind, request.payload, call.timeout))

    def _keep(self, call: _Call) -> int:
        handle = self._context.new_handle()
        self._open[handle] = call
        return handle

    def receive(self, answer: ServiceResult | ServiceFound | ParamsChanged) -> bool:
        """Take an answer of the hub; False if it is to no call here."""
        call = self._open.pop(answer.handle, None)
        if call is None:
            return False
        try:
            if isinstance(answer, ServiceResult):
                self._finish(call, answer)
            elif call.todo is not None:
                found = answer.type if isinstance(answer, ServiceFound) else ""
                self._answer(call, self._rosapi.finish(call.todo, found))
            elif isinstance(answer, ServiceFound):
                if not answer.type:
                    raise OpError(f"the type of {call.name} is not known", "give its 'type'")
                self._begin(call, answer.type)
        except RmpaError as error:
            self._fail(call, str(error))
        return True

    def _finish(self, call: _Call, result: ServiceResult) -> None:
        if not result.ok:
            self._fail(call, result.error)
        elif call.response is None:
            self._fail(call, "an answer came before the call")
        else:
            self._answer(call, _values(call.response, result.payload, call.style))

    def fail(self, failed: Failed) -> bool:
        """The hub cannot do a call; False if it is none of these."""
        call = self._open.pop(failed.handle, None)
        if call is None:
            return False
        if isinstance(call.todo, FindType | FindTypes):
            self._answer(call, self._rosapi.finish(call.todo))  # rosapi's answer for an unknown service
        else:
            self._fail(call, str(OpError(failed.error, failed.remedy)))
        return True

    def close(self) -> None:
        """Forget all; the hub need not answer."""
        for handle in self._open:
            self._context.ask(CancelCall(handle))
        self._open.clear()

    def _answer(self, call: _Call, values: Any, *, ok: bool = True) -> None:
        op = {"op": "service_response", "service": call.service, "values": values, "result": ok}
        self._context.send_op(op if call.mid is None else op | {"id": call.mid}, call.style, call.mid)

    def _fail(self, call: _Call, text: str) -> None:
        self._answer(call, text[: limits.TEXT_MAX], ok=False)


def _values(codec: MessageCodec, payload: Payload, style: Style) -> dict[str, Any]:
    view = memoryview(payload)
    return codec.cbor_values(view) if style.compression >= Compression.CBOR else codec.json_values(view)


def _timeout(timeout: float | None) -> float | None:
    if timeout is not None and not 0 < timeout < float("inf"):
        raise OpError(f"a timeout is more than 0 s, not {timeout}")
    return timeout
