"""The session of a rosbridge client: publishes, calls and serves.

Services that a client calls: those of rosapi are answered here, all others by the hub.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

from rmpa.core.errors import RmpaError
from rmpa.ros.types.codec import MessageCodec, codec_for
from rmpa.web import limits
from rmpa.web.hub.requests import (
    AdvertiseTopic,
    Answer,
    CallService,
    CancelCall,
    DeleteParam,
    EndService,
    Failed,
    FindService,
    FindServices,
    HubRequest,
    OtherType,
    ParamsChanged,
    PublishMessage,
    ReceivedMessage,
    Respond,
    ServeService,
    ServiceFound,
    ServiceRequest,
    ServiceResult,
    SetParam,
    UnadvertiseTopic,
)
from rmpa.web.rosbridge import protocol
from rmpa.web.rosbridge.protocol import (
    Compression,
    Id,
    OpError,
    Part,
    PublishFrames,
    RosbridgeFrame,
    decode_png,
    graph_name,
    id_of,
    parse_frame,
    parse_op,
    type_name,
)
from rmpa.web.rosbridge.rosapi import DeleteParameter, FindType, FindTypes, Rosapi, SetParameter, Todo
from rmpa.web.rosbridge.subscriptions import LEVELS, Assembler, SessionContext, Style, Subscriptions, check_count

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.web.hub.graph import TypeLibrary
    from rmpa.web.hub.requests import Payload
    from rmpa.web.rosbridge.rosapi import HubGraph


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


# Services that a client offers: calls go to it as ``call_service``, it answers by ``service_response``.


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


# What a client publishes: one publisher of the hub for each topic, however often the client advertises it.


@dataclass(slots=True)
class _Publisher:
    handle: int
    topic: str
    type: str
    latch: bool
    codec: MessageCodec
    ids: set[Id] = field(default_factory=set)


class Publications:
    """All publishers of a client.

    Args:
        context: The session.
    """

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._publishers: dict[str, _Publisher] = {}

    def advertise(self, op: protocol.RosbridgeAdvertise) -> None:
        """Begin a publisher, or count one more id of it.

        Raises:
            OpError: The topic has another type.
            DefinitionError: The type is not known.
        """
        name, kind = graph_name(op.topic), type_name(op.type)
        publisher = self._publishers.get(name)
        if publisher is not None and publisher.type != kind:
            raise OpError(f"{name} is advertised as {publisher.type}, not {kind}", "unadvertise it first")
        if publisher is not None and publisher.latch != bool(op.latch):
            ids = publisher.ids
            self._end(publisher)
            publisher = self._begin(name, kind, latch=bool(op.latch))
            publisher.ids |= ids
        if publisher is None:
            publisher = self._begin(name, kind, latch=bool(op.latch))
        if op.id not in publisher.ids:
            check_count(len(publisher.ids), limits.SUBSCRIBERS_MAX, f"advertisements of {name}")
        publisher.ids.add(op.id)
        self._context.status("info", f"advertised {name}", op.id)

    def unadvertise(self, op: protocol.RosbridgeUnadvertise) -> None:
        """Forget the id's advertisement, or all; the publisher ends with the last."""
        name = graph_name(op.topic)
        publisher = self._publishers.get(name)
        if publisher is None:
            self._context.status("warning", f"{name} is not advertised", op.id)
            return
        if op.id is None:
            publisher.ids.clear()
        else:
            publisher.ids.discard(op.id)
        if not publisher.ids:
            self._end(publisher)
        self._context.status("info", f"unadvertised {name}", op.id)

    def publish(self, op: protocol.RosbridgePublish) -> None:
        """Publish a message; a topic that was not advertised is, with the type that the graph knows.

        Raises:
            OpError: The topic was not advertised, and no type is known for it.
            MessageError: The message does not fit the type.
        """
        name = graph_name(op.topic)
        publisher = self._publishers.get(name) or self._begin(name, self._type_of(name), latch=bool(op.latch))
        written = publisher.codec.write({} if op.msg is None else op.msg, self._context.ros_time_ns())
        if written.missing:
            fields = ", ".join(written.missing)
            self._context.status("warning", f"publish {name}: these fields were not given: {fields}", op.id)
        self._context.ask(PublishMessage(publisher.handle, written.payload))

    def fail(self, failed: Failed) -> bool:
        """The hub cannot serve a publisher; False if it is none of these."""
        for publisher in self._publishers.values():
            if publisher.handle == failed.handle:
                del self._publishers[publisher.topic]
                problem = str(OpError(f"advertise {publisher.topic}: {failed.error}", failed.remedy))
                for mid in publisher.ids or {None}:
                    self._context.status("error", problem, mid)
                return True
        return False

    def close(self) -> None:
        """End all."""
        for publisher in list(self._publishers.values()):
            self._end(publisher)

    def _type_of(self, name: str) -> str:
        topic = self._context.graph.topics.get(name)
        if topic is None or not topic.types:
            raise OpError(f"publish {name}: the topic is not there, and its type is not known", "advertise it first")
        return topic.types[0]

    def _begin(self, name: str, kind: str, *, latch: bool) -> _Publisher:
        check_count(len(self._publishers), limits.ADVERTISED_MAX, "advertised topics")
        topic = self._context.graph.topics.get(name)
        if topic is not None and topic.types and kind not in topic.types:
            raise OpError(f"{name} has the type {', '.join(topic.types)}, not {kind}", "advertise it with that type")
        codec = codec_for(self._context.types.message(kind))
        publisher = _Publisher(self._context.new_handle(), name, kind, latch, codec)
        self._publishers[name] = publisher
        self._context.ask(AdvertiseTopic(publisher.handle, name, kind, latch))
        return publisher

    def _end(self, publisher: _Publisher) -> None:
        del self._publishers[publisher.topic]
        self._context.ask(UnadvertiseTopic(publisher.handle))


# One rosbridge client: frames and the hub's answers in, frames and requests to the hub out. No I/O, no clock.


class RosbridgeSession:
    """The state of one client.

    After each call of `receive_frame`, `receive_answer`, `handle_timer` and `close`, its user sends `frames_to_send`,
    and gives `requests_to_send` to the hub.

    Args:
        types: Finds definitions.
        graph: The snapshot of the graph.
        ros_time_ns: The present ROS time in nanoseconds: UTC, or that of ``/clock``.
        frames: Encodes messages; one for all sessions of a process.
    """

    def __init__(
        self,
        types: TypeLibrary,
        graph: HubGraph,
        ros_time_ns: Callable[[], int],
        *,
        frames: PublishFrames,
    ) -> None:
        self._context = SessionContext(types, graph, ros_time_ns)
        self._fragments = Assembler()
        self._subscriptions = Subscriptions(self._context, frames)
        self._publications = Publications(self._context)
        self._calls = Calls(self._context, Rosapi(graph, types, ros_time_ns))
        self._served = RosbridgeServedServices(self._context)
        self._handlers: Mapping[type[protocol.Op], Callable[[Any], None]] = {
            protocol.RosbridgeUnsubscribe: self._subscriptions.unsubscribe,
            protocol.RosbridgeAdvertise: self._publications.advertise,
            protocol.RosbridgeUnadvertise: self._publications.unadvertise,
            protocol.RosbridgePublish: self._publications.publish,
            protocol.RosbridgeCallService: self._calls.call,
            protocol.AdvertiseService: self._served.advertise,
            protocol.UnadvertiseService: self._served.unadvertise,
            protocol.ServiceResponse: self._served.respond,
            protocol.SetLevel: self._set_level,
            protocol.RosbridgeStatus: lambda _: None,
        }

    # --- in -------------------------------------------------------------------------------------------------------

    def receive_frame(self, data: str | Part, now: float) -> None:
        """Take a frame of the client: text, or bytes of a binary frame. What is wrong is answered by a status."""
        mid: Id = None
        try:
            values = parse_frame(data)
            mid = id_of(values)
            self._handle(values, now, 0)
        except RmpaError as error:
            self._context.status("error", str(error), mid)

    def _handle(self, values: Mapping[str, Any], now: float, depth: int) -> None:
        name, op = parse_op(values)
        try:
            if isinstance(op, protocol.Fragment | protocol.Png):
                self._unwrap(op, now, depth)
            elif isinstance(op, protocol.RosbridgeSubscribe):
                self._subscriptions.subscribe(op, now)
            else:
                self._handlers[type(op)](op)
        except RmpaError as error:
            self._context.status("error", f"{name}: {error}", op.id)

    def _unwrap(self, op: protocol.Fragment | protocol.Png, now: float, depth: int) -> None:
        """Handle the op within a fragment or picture.

        Raises:
            RmpaError: The op is malformed, or wrapped more than twice.
        """
        if depth > 1:
            raise OpError("fragments and pictures are within each other once only")
        whole: str | None = op.data
        if isinstance(op, protocol.Fragment):
            whole = self._fragments.add("fragment", op.id, op.num, op.total, op.data, now)
        elif op.num is not None or op.total is not None:
            if op.id is None or op.num is None or op.total is None:
                raise OpError("a fragmented png has 'id', 'num' and 'total'")
            whole = self._fragments.add("png", op.id, op.num, op.total, op.data, now)
        if whole is not None:
            text = decode_png(whole) if isinstance(op, protocol.Png) else whole
            self._handle(parse_frame(text), now, depth + 1)

    def warn(self, text: str, level: str = "warning") -> None:
        """Send a status of the server's own, if the client wants those of its level."""
        self._context.status(level, text)

    def _set_level(self, op: protocol.SetLevel) -> None:
        if op.level not in LEVELS:
            raise OpError(f"unknown level {op.level[:40]!r}", f"it is one of {', '.join(LEVELS)}")
        self._context.level = op.level

    def receive_answer(self, answer: Answer, now: float) -> None:
        """Take what the hub answers. Answers to what has ended are ignored."""
        if isinstance(answer, ReceivedMessage):
            self._subscriptions.receive(answer, now)
        elif isinstance(answer, ServiceRequest):
            self._served.request(answer)
        elif isinstance(answer, ServiceResult | ServiceFound | ParamsChanged):
            self._calls.receive(answer)
        elif isinstance(answer, OtherType):
            self._subscriptions.differs(answer)
        elif isinstance(answer, Failed):
            parts = (self._subscriptions, self._publications, self._calls, self._served)
            any(part.fail(answer) for part in parts)

    # --- out ------------------------------------------------------------------------------------------------------

    def frames_to_send(self) -> list[RosbridgeFrame]:
        """The frames for the client since the last call."""
        frames, self._context.frames = self._context.frames, []
        return frames

    def requests_to_send(self) -> list[HubRequest]:
        """The requests for the hub since the last call."""
        requests, self._context.requests = self._context.requests, []
        return requests

    # --- time -----------------------------------------------------------------------------------------------------

    def next_timer(self) -> float | None:
        """When `handle_timer` is to be called; None for never."""
        parts = (self._subscriptions, self._fragments)
        return min((at for part in parts if (at := part.next_timer()) is not None), default=None)

    def handle_timer(self, now: float) -> None:
        """Do what is due."""
        self._subscriptions.handle_timer(now)
        for mid in self._fragments.expire(now):
            self._context.status(
                "warning", f"no next fragment came for {limits.FRAGMENT_TIMEOUT:g} s", cast("Id", mid)
            )

    def close(self) -> None:
        """The client has gone: `requests_to_send` then ends all that it had."""
        for part in (self._subscriptions, self._publications, self._calls, self._served):
            part.close()
        self._context.frames.clear()
