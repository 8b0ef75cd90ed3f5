"""Services that a client offers: calls go to it as ``call_service``, it answers by ``service_response``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.core.errors import RmpaError
from rmpa.web.hub.requests import EndService, Respond, ServeService, ServiceRequest
from rmpa.web.rosbridge import limits
from rmpa.web.rosbridge.context import Style, check_count
from rmpa.web.rosbridge.protocol import OpError, graph_name, type_name
from rmpa.web.values.codec import MessageCodec, codec_for

if TYPE_CHECKING:
    from rmpa.web.hub.requests import Failed
    from rmpa.web.rosbridge import protocol
    from rmpa.web.rosbridge.context import SessionContext


@dataclass(slots=True)
class _Served:
    """A service of the client; `spelling` is as the client writes its name."""

    handle: int
    name: str
    spelling: str
    request: MessageCodec
    response: MessageCodec
    calls: dict[str, int] = field(default_factory=dict)
    """The hub's number of each call that is open, by the id that the client got."""


class RosbridgeServedServices:
    """All services that a client offers.

    Args:
        context: The session.
    """

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._services: dict[str, _Served] = {}
        self._asked = 0

    def advertise(self, op: protocol.AdvertiseService) -> None:
        """Offer a service; one that the client offers already is offered anew.

        Raises:
            OpError: The name or the type is none, or the client offers too many.
            DefinitionError: The type is not known.
        """
        name = graph_name(op.service)
        kind = self._context.types.service(type_name(op.type))
        old = self._services.get(name)
        if old is not None:
            self._context.status("warning", f"{name} is advertised already: it is offered anew", op.id)
            self._end(old, "the service is offered anew")
        check_count(len(self._services), limits.SERVED_MAX, "advertised services")
        served = _Served(
            self._context.new_handle(), name, op.service, codec_for(kind.request), codec_for(kind.response)
        )
        self._services[name] = served
        self._context.ask(ServeService(served.handle, name, kind.name))
        self._context.status("info", f"advertised service {name}", op.id)

    def unadvertise(self, op: protocol.UnadvertiseService) -> None:
        """Offer a service no longer; its open calls fail.

        Raises:
            OpError: The client does not offer it.
        """
        name = graph_name(op.service)
        served = self._services.get(name)
        if served is None:
            raise OpError(f"service {name} is not advertised by this client")
        self._end(served, "the service was unadvertised")
        self._context.status("info", f"unadvertised service {name}", op.id)

    def request(self, request: ServiceRequest) -> None:
        """Pass a call on to the client, or refuse it."""
        served = next((each for each in self._services.values() if each.handle == request.handle), None)
        if served is None:
            self._refuse(request.handle, request.call, "the service is no longer offered")
            return
        try:
            check_count(sum(len(each.calls) for each in self._services.values()), limits.REQUESTS_MAX, "open calls")
            arguments = served.request.json_values(memoryview(request.payload))
        except RmpaError as error:
            self._refuse(request.handle, request.call, str(error))
            return
        self._asked += 1
        mid = f"service_request:{served.spelling}:{self._asked}"
        served.calls[mid] = request.call
        op = {"op": "call_service", "id": mid, "service": served.spelling, "args": arguments}
        self._context.send_op(op, Style())

    def respond(self, op: protocol.ServiceResponse) -> None:
        """Take the client's answer. One that does not fit the type fails the call, and is reported.

        Raises:
            OpError: There is no such call.
            MessageError: The values do not fit the type.
        """
        name = graph_name(op.service)
        served = self._services.get(name)
        if served is None:
            raise OpError(f"service {name} is not advertised by this client")
        call = served.calls.pop(op.id, None) if isinstance(op.id, str) else None
        if call is None:
            raise OpError(f"service {name} has no open call of this id", "answer with the id of the call_service")
        # rosbridge_suite does not look at ``result``, and clients send false with a response that counts.
        if not op.result and not (isinstance(op.values, dict) and op.values):
            text = op.values if isinstance(op.values, str) else "the service failed"
            self._refuse(served.handle, call, text)
            return
        try:
            written = served.response.write_arguments(op.values, self._context.ros_time_ns())
        except RmpaError as error:
            self._refuse(served.handle, call, str(error))
            raise
        self._context.ask(Respond(served.handle, call, ok=True, response=written.payload))

    def fail(self, failed: Failed) -> bool:
        """The hub cannot offer a service; False if it is none of these."""
        for served in self._services.values():
            if served.handle == failed.handle:
                del self._services[served.name]
                problem = str(OpError(failed.error, failed.remedy))
                self._context.status("error", f"advertise_service {served.name}: {problem}")
                return True
        return False

    def close(self) -> None:
        """End all; open calls fail."""
        for served in list(self._services.values()):
            self._end(served, "the client that offers the service has gone")

    def _end(self, served: _Served, reason: str) -> None:
        del self._services[served.name]
        for call in served.calls.values():
            self._refuse(served.handle, call, reason)
        self._context.ask(EndService(served.handle))

    def _refuse(self, handle: int, call: int, text: str) -> None:
        self._context.ask(Respond(handle, call, ok=False, response=text[: limits.TEXT_MAX]))
