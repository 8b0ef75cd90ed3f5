"""The session of a rosbridge client: subscribes, publishes, calls and serves; no I/O, no clock."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Final, cast

from rmpa.core.errors import RmpaError
from rmpa.ros.types.codec import MessageCodec, codec_for
from rmpa.web.hub.connection import ClientStream, Session, ops_of
from rmpa.web.rosbridge import limits
from rmpa.web.rosbridge.protocol import (
    Assembler,
    Compression,
    Id,
    OpError,
    Part,
    check_count,
    decode_png,
    encode,
    encode_cbor_raw,
    encode_message,
    graph_name,
    id_of,
    parse_frame,
    read_op,
    split,
    type_name,
    whole,
)
from rmpa.web.rosbridge.rosapi import Rosapi
from rmpa.web.rosbridge.tf import TfRepublisher

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Coroutine, Mapping

    from rmpa.web.hub.frame_writer import OutFrame
    from rmpa.web.hub.hub import Hub
    from rmpa.web.hub.node_link import Follower, Payload, Rights
    from rmpa.web.hub.services import ServedService
    from rmpa.web.hub.topics import ClientPublication, ClientSubscription, ReceivedMessage

# Each includes those before it.
LEVELS: Final = ("none", "error", "warning", "info")


class _Topic(ClientStream):
    """A subscribed topic: several ids of one topic are one subscription of the hub.

    Its messages have the lowest throttle_rate and fragment_size, the highest queue_length, and the highest
    compression of none, png, cbor and cbor-raw.

    Args:
        session: The client.
        name: As the client writes it.
        topic: The global name.
        kind: The type that is wanted; None for any.
    """

    subscription: ClientSubscription | Follower

    def __init__(self, session: RosbridgeSession, name: str, topic: str, kind: str | None) -> None:
        self._session = session
        self.name = name
        self.topic = topic
        self.type = kind
        # What each id asked for: interval, queue, fragment size and compression.
        self.wishes: dict[Id, tuple[float, int, int | None, Compression]] = {}
        # When it fails, if the topic is not there by then.
        self.judged_at: float | None = None
        self._compression = Compression.NONE
        self._fragment_size: int | None = None
        self._problem = ""

    def choose(self) -> None:
        """Choose from all wishes."""
        intervals, lengths, sizes, compressions = zip(*self.wishes.values(), strict=True)
        length = min(max(lengths), limits.QUEUE_MESSAGES_MAX)
        self._session.connection.pace(self, min(intervals), length)
        self._compression = max(compressions)
        self._fragment_size = min(filter(None, sizes), default=None)

    def frames(self, message: ReceivedMessage) -> list[OutFrame]:
        """The frames of a message; none of one that is broken."""
        try:
            return self._session.split(self._encode(message), self._fragment_size)
        except RmpaError as error:
            # Once: a publisher of broken messages may send a thousand a second.
            if self._problem != str(error):
                self._problem = str(error)
                self._session.status("error", f"message of {self.name}: {error}")
            return []

    def _encode(self, message: ReceivedMessage) -> OutFrame:
        if self._compression is Compression.CBOR_RAW:
            return encode_cbor_raw(self.name, message.payload, message.stamp_ns)
        hub = self._session.hub

        def make() -> OutFrame:
            codec = hub.types.codec(message.type, message.md5sum)
            return encode_message(self.name, message.payload, self._compression, codec)

        return hub.frames.get(message.payload, make, self.name, self._compression)


@dataclass(slots=True)
class _Publisher:
    topic: str
    type: str
    latch: bool
    codec: MessageCodec
    publication: ClientPublication = field(init=False)
    ids: set[Id] = field(default_factory=set)


@dataclass(slots=True, eq=False)
class _Call:
    """A call without an answer; `service` is as the client writes it."""

    service: str
    mid: Id
    compression: Compression = Compression.NONE
    fragment_size: int | None = None


@dataclass(slots=True)
class _Served:
    """A service of the client; `spelling` is as the client writes its name."""

    name: str
    spelling: str
    request: MessageCodec
    response: MessageCodec
    service: ServedService = field(init=False)
    # The response of each call that is open, by the id that the client got.
    calls: dict[str, asyncio.Future[Payload]] = field(default_factory=dict)


class RosbridgeSession(Session):
    """One client. Each op is a method whose keywords are the op's fields.

    Args:
        hub: The hub.
        rights: What the client may do.
        address: The client's, for logs.
    """

    kind = "rosbridge"
    frame_max = limits.FRAME_MAX

    # More than 12 fields: what the client has of each kind, and what it has in fragments.
    def __init__(self, hub: Hub, rights: Rights, address: str) -> None:
        super().__init__(hub, rights, address)
        self._rosapi = Rosapi(self)
        self._tf = TfRepublisher(self)
        self._level = "error"
        self._now = 0.0
        self._depth = 0
        self._fragments = Assembler()
        self._fragment_ids = itertools.count()
        self._topics: dict[str, _Topic] = {}
        self._publishers: dict[str, _Publisher] = {}
        self._calls: set[_Call] = set()
        self._services: dict[str, _Served] = {}
        self._asked = 0

    def opened(self) -> None:
        """Count the client; nothing is sent first."""
        self.hub.counts.add(self, self.address)

    def closing(self) -> None:
        """End what the hub does not know of."""
        self._tf.close()

    def received_frame(self, data: str | Part, now: float) -> None:
        """Take a frame of the client: text, or bytes of a binary frame. What is wrong is answered by a status."""
        self._now = now
        mid: Id = None
        try:
            values = parse_frame(data)
            mid = id_of(values)
            self._handle(values)
        except RmpaError as error:
            self.status("error", str(error), mid)

    def _handle(self, values: Mapping[str, Any]) -> None:
        name, fields = read_op(values, OPS)
        try:
            getattr(self, f"op_{name}")(**fields)
        except RmpaError as error:
            self.status("error", f"{name}: {error}", fields["id_"])

    def warn(self, text: str, subject: str) -> None:
        """Send a status: an error of what is published too late, else a warning."""
        self.status("error" if subject == "late" else "warning", text)

    def status(self, level: str, text: str, mid: Id = None) -> None:
        """Send a status message, if the client wants those of this level."""
        if LEVELS.index(level) <= LEVELS.index(self._level):
            values: dict[str, Any] = {"op": "status", "level": level, "msg": text[: limits.TEXT_MAX]}
            self.connection.push(encode(values if mid is None else values | {"id": mid}))

    def split(self, frame: OutFrame, fragment_size: int | None, mid: Id = None) -> list[OutFrame]:
        """A frame, in fragments where it is text and longer than `fragment_size` characters."""
        if fragment_size is None:
            return [frame]
        try:
            return split(frame, fragment_size, mid if mid is not None else next(self._fragment_ids))
        except OpError as error:
            self.status("error", str(error), mid)
            return []

    def next_timer(self) -> float | None:
        """When `handle_timer` is to be called; None for never."""
        times = [
            self._fragments.next_timer(),
            self._tf.next_timer(),
            *(topic.judged_at for topic in self._topics.values()),
        ]
        return min((at for at in times if at is not None), default=None)

    def handle_timer(self, now: float) -> None:
        """Send transforms that are due, and end what waits in vain."""
        self._tf.handle_timer(now)
        for topic in [*self._topics.values()]:
            if topic.judged_at is not None and topic.judged_at <= now:
                topic.judged_at = None
                if not self._is_there(topic.topic):
                    error = OpError("the topic is not there, and its type is not known", "give its 'type'")
                    self._subscription_failed(topic, error)
        for mid in self._fragments.expire(now):
            self.status("warning", f"no next fragment came for {limits.FRAGMENT_TIMEOUT:g} s", cast("Id", mid))

    def op_set_level(self, *, id_: Id = None, level: str) -> None:  # noqa: ARG002
        """Which status messages the client wants."""
        if level not in LEVELS:
            raise OpError(f"unknown level {level[:40]!r}", f"it is one of {', '.join(LEVELS)}")
        self._level = level

    def op_status(self, *, id_: Id = None) -> None:
        """A status message of the client has no effect."""

    def op_fragment(self, *, id_: str | int, data: str, num: int, total: int) -> None:
        """A part of an op."""
        self._unwrap(self._fragments.add("fragment", id_, num, total, data, self._now))

    def op_png(self, *, id_: Id = None, data: str, num: int | None = None, total: int | None = None) -> None:
        """An op as the bytes of a picture, or a fragment of one."""
        whole: str | None = data
        if num is not None or total is not None:
            if id_ is None or num is None or total is None:
                raise OpError("a fragmented png has 'id', 'num' and 'total'")
            whole = self._fragments.add("png", id_, num, total, data, self._now)
        self._unwrap(decode_png(whole) if whole is not None else None)

    def _unwrap(self, text: str | None) -> None:
        if text is None:
            return
        if self._depth > 1:
            raise OpError("fragments and pictures are within each other once only")
        self._depth += 1
        try:
            self._handle(parse_frame(text))
        finally:
            self._depth -= 1

    def op_subscribe(
        self,
        *,
        id_: Id = None,
        topic: str,
        type_: str | None = None,
        throttle_rate: float | None = 0,
        queue_length: float | None = 0,
        fragment_size: float | None = None,
        compression: str | None = "none",
    ) -> None:
        """Begin a subscription, or change that of the same id.

        Without a type it fails where the topic does not appear within `limits.TYPE_WAIT`. `throttle_rate` is in
        milliseconds, `fragment_size` in characters.
        """
        name = graph_name(topic)
        chosen = Compression.parse(compression)
        kind = type_name(type_) if type_ else None
        interval = whole(throttle_rate, "throttle_rate") / 1000
        wish = interval, whole(queue_length, "queue_length"), _fragment_size(fragment_size), chosen
        if chosen is Compression.CBOR_RAW:
            kind = None  # bytes of any type
        there = self._topics.get(topic)
        if there is None:
            there = self._begin_topic(topic, name, kind)
            if type_ is None and chosen is not Compression.CBOR_RAW and not self._is_there(name):
                there.judged_at = self._now + limits.TYPE_WAIT
        elif kind is not None and there.type is not None and kind != there.type:
            raise OpError(f"{topic} is subscribed as {there.type}, not {kind}", "unsubscribe it first")
        if id_ not in there.wishes:
            check_count(len(there.wishes), limits.SUBSCRIBERS_MAX, f"subscriptions of {topic}")
        there.wishes[id_] = wish
        there.choose()
        self.status("info", f"subscribed to {topic}", id_)

    def op_unsubscribe(self, *, id_: Id = None, topic: str) -> None:
        """End the subscription with the op's id, or all of the topic."""
        there = self._topics.get(topic)
        if there is None or (id_ is not None and id_ not in there.wishes):
            self.status("warning", f"{topic[: limits.NAME_MAX]} is not subscribed", id_)
            return
        if id_ is None:
            there.wishes.clear()
        else:
            del there.wishes[id_]
        if there.wishes:
            there.choose()
        else:
            self._end_topic(there)
        self.status("info", f"unsubscribed from {topic}", id_)

    def _is_there(self, name: str) -> bool:
        known = self.hub.graph.topics.get(name)
        is_own = name in self.hub.topics.published or self._tf.publishes(name)
        return bool(known is not None and known.types) or is_own

    def _begin_topic(self, spelling: str, name: str, kind: str | None) -> _Topic:
        check_count(len(self._topics), limits.SUBSCRIPTIONS_MAX, "subscribed topics")
        known = self.hub.graph.topics.get(name)
        if kind is not None and known is not None and known.types and kind not in known.types:
            raise OpError(f"{spelling} has the type {', '.join(known.types)}, not {kind}", "subscribe with that type")
        topic = _Topic(self, spelling, name, kind)
        take = partial(self.connection.push_message, topic)
        failed, differs = partial(self._subscription_failed, topic), partial(self._differs, topic)
        if self._tf.publishes(name):
            topic.subscription = self._tf.subscribe(name, take)
        else:
            topic.subscription = self.subscribe(name, kind, take, failed, differs)
        self._topics[spelling] = topic
        return topic

    def _differs(self, topic: _Topic, type_: str) -> None:
        error = OpError(f"{topic.name} has the type {type_}, not {topic.type}", "subscribe with that type")
        for mid in topic.wishes:
            self.status("error", f"subscribe: {error}", mid)

    def _subscription_failed(self, topic: _Topic, error: RmpaError) -> None:
        self._end_topic(topic)
        for mid in topic.wishes:
            self.status("error", f"subscribe {topic.name}: {error}", mid)

    def _end_topic(self, topic: _Topic) -> None:
        del self._topics[topic.name]
        self.connection.queue.end(topic)
        topic.subscription.close()

    def op_advertise(self, *, id_: Id = None, topic: str, type_: str, latch: bool | None = False) -> None:
        """Begin a publisher, or count one more id of it."""
        name, kind = graph_name(topic), type_name(type_)
        if self._tf.takes(name):
            return
        self.check_control("publish")
        publisher = self._publishers.get(name)
        if publisher is not None and publisher.type != kind:
            raise OpError(f"{name} is advertised as {publisher.type}, not {kind}", "unadvertise it first")
        if publisher is not None and publisher.latch != bool(latch):
            ids = publisher.ids
            self._end_publisher(publisher)
            publisher = self._begin_publisher(name, kind, latch=bool(latch))
            publisher.ids |= ids
        if publisher is None:
            publisher = self._begin_publisher(name, kind, latch=bool(latch))
        if id_ not in publisher.ids:
            check_count(len(publisher.ids), limits.SUBSCRIBERS_MAX, f"advertisements of {name}")
        publisher.ids.add(id_)
        self.status("info", f"advertised {name}", id_)

    def op_unadvertise(self, *, id_: Id = None, topic: str) -> None:
        """Forget the id's advertisement, or all; the publisher ends with the last."""
        name = graph_name(topic)
        publisher = self._publishers.get(name)
        if publisher is None:
            self.status("warning", f"{name} is not advertised", id_)
            return
        if id_ is None:
            publisher.ids.clear()
        else:
            publisher.ids.discard(id_)
        if not publisher.ids:
            self._end_publisher(publisher)
        self.status("info", f"unadvertised {name}", id_)

    def op_publish(self, *, id_: Id = None, topic: str, msg: Any = None, latch: bool | None = False) -> None:
        """Publish a message; a topic that was not advertised is, with the type that the graph knows."""
        name = graph_name(topic)
        if self._tf.takes(name):
            self._tf.publish(name, msg, self._now)
            return
        self.check_control("publish")
        publisher = self._publishers.get(name)
        if publisher is None:
            known = self.hub.graph.topics.get(name)
            if known is None or not known.types:
                problem = f"publish {name}: the topic is not there, and its type is not known"
                raise OpError(problem, "advertise it first")
            publisher = self._begin_publisher(name, known.types[0], latch=bool(latch))
        written = publisher.codec.write({} if msg is None else msg, self.hub.time.now_ns())
        if written.missing:
            fields = ", ".join(written.missing)
            self.status("warning", f"publish {name}: these fields were not given: {fields}", id_)
        publisher.publication.publish(written.payload)

    def _begin_publisher(self, name: str, kind: str, *, latch: bool) -> _Publisher:
        check_count(len(self._publishers), limits.ADVERTISED_MAX, "advertised topics")
        topic = self.hub.graph.topics.get(name)
        if topic is not None and topic.types and kind not in topic.types:
            raise OpError(f"{name} has the type {', '.join(topic.types)}, not {kind}", "advertise it with that type")
        publisher = _Publisher(name, kind, latch, codec_for(self.hub.types.message(kind)))
        failed = partial(self._publisher_failed, publisher)
        publisher.publication = self.advertise(name, kind, failed, latch=latch)
        self._publishers[name] = publisher
        return publisher

    def _publisher_failed(self, publisher: _Publisher, error: RmpaError) -> None:
        del self._publishers[publisher.topic]
        for mid in publisher.ids or {None}:
            self.status("error", f"advertise {publisher.topic}: {error}", mid)

    def _end_publisher(self, publisher: _Publisher) -> None:
        del self._publishers[publisher.topic]
        publisher.publication.close()

    def op_call_service(
        self,
        *,
        id_: Id = None,
        service: str,
        args: Any = None,
        type_: str | None = None,
        fragment_size: float | None = None,
        compression: str | None = "none",
        timeout: float | None = None,
    ) -> None:
        """Begin a call; each ends with one ``service_response``, also if it fails, and with nothing beside it.

        A ``status`` beside it would be an error of its own to roslib and roslibpy, which have no handler for it.
        `args` are an object or the fields in order; `timeout` is in seconds.
        """
        # An old way to give an id: /service#id.
        spelling, mark, suffix = service.partition("#")
        call = _Call(service[: limits.NAME_MAX], id_ if id_ is not None or not mark else suffix)
        try:
            call.compression, call.fragment_size = Compression.parse(compression), _fragment_size(fragment_size)
            name = graph_name(spelling)
            if timeout is not None and not 0 < timeout < float("inf"):
                raise OpError(f"a timeout is more than 0 s, not {timeout}")
            check_count(len(self._calls), limits.CALLS_MAX, "open calls")
            if self._rosapi.offers(name):
                self._ask_rosapi(call, name, args)
            elif self._tf.serves(name):
                self._answer(call, self._tf.call(args, self._now))
            else:
                known = self.hub.graph.services.get(name)
                kind = type_name(type_) if type_ else known.type if known is not None else ""
                self._begin_call(call, name, args, timeout, kind)
        except RmpaError as error:
            self._call_failed(call, error)

    def _ask_rosapi(self, call: _Call, name: str, args: Any) -> None:
        answer = self._rosapi.call(name, args)
        if isinstance(answer, dict):
            self._answer(call, answer)
        else:
            self._await(call, answer, lambda values: self._answer(call, values or {}))

    def _begin_call(self, call: _Call, name: str, args: Any, timeout: float | None, kind: str) -> None:
        if not kind:
            self._await(call, self.find_service(name), partial(self._begin_call, call, name, args, timeout))
            return
        service = self.hub.types.service(kind)
        request = codec_for(service.request).write_arguments(args, self.hub.time.now_ns())
        if request.missing:
            fields = ", ".join(request.missing)
            self.status("warning", f"call_service {name}: not given: {fields}", call.mid)
        work = self.call(name, kind, request.payload, timeout)
        self._await(call, work, partial(self._called, call, codec_for(service.response)))

    def _await(self, call: _Call, work: Coroutine[Any, Any, Any], done: Callable[[Any], None]) -> None:
        self._calls.add(call)
        self.run(work, done, partial(self._call_failed, call))

    def _called(self, call: _Call, codec: MessageCodec, payload: Payload) -> None:
        view = memoryview(payload)
        cbor = call.compression >= Compression.CBOR
        self._answer(call, codec.cbor_values(view) if cbor else codec.json_values(view))

    def _call_failed(self, call: _Call, error: RmpaError) -> None:
        self._answer(call, str(error)[: limits.TEXT_MAX], ok=False)

    def _answer(self, call: _Call, values: Any, *, ok: bool = True) -> None:
        self._calls.discard(call)
        op = {"op": "service_response", "service": call.service, "values": values, "result": ok}
        frame = encode(op if call.mid is None else op | {"id": call.mid}, call.compression)
        self.connection.push(*self.split(frame, call.fragment_size, call.mid))

    def op_send_action_goal(
        self, *, id_: Id, action: str, args: Any = None, fragment_size: float | None = None
    ) -> None:
        """A goal of the one action that is answered here; its feedback comes until it is cancelled."""
        size = _fragment_size(fragment_size)
        push = lambda op: self.connection.push(*self.split(encode(op), size))  # noqa: E731
        self._tf.send_goal(graph_name(action), id_, args, self._now, push)

    def op_cancel_action_goal(self, *, id_: Id, action: str) -> None:
        """End such a goal."""
        self.connection.push(*map(encode, self._tf.cancel_goal(graph_name(action), id_)))

    def op_advertise_service(self, *, id_: Id = None, service: str, type_: str) -> None:
        """Offer a service; one that the client offers already is offered again."""
        self.check_control("offer services")
        name = graph_name(service)
        kind = self.hub.types.service(type_name(type_))
        old = self._services.get(name)
        if old is not None:
            self.status("warning", f"{name} is advertised already: it is offered again", id_)
            self._end_service(old, "the service is offered again")
        check_count(len(self._services), limits.SERVED_MAX, "advertised services")
        served = _Served(name, service, codec_for(kind.request), codec_for(kind.response))
        asked, failed = partial(self._asked_for, served), partial(self._service_failed, served)
        served.service = self.serve(name, kind.name, asked, failed)
        self._services[name] = served
        self.status("info", f"advertised service {name}", id_)

    def op_unadvertise_service(self, *, id_: Id = None, service: str) -> None:
        """Offer a service no longer; its open calls fail."""
        served = self._service(service)
        self._end_service(served, "the service was unadvertised")
        self.status("info", f"unadvertised service {served.name}", id_)

    def op_service_response(self, *, id_: Id = None, service: str, values: Any = None, result: bool = True) -> None:
        """Take the client's answer. One that does not fit the type fails the call, and is reported."""
        served = self._service(service)
        response = served.calls.pop(id_, None) if isinstance(id_, str) else None
        if response is None or response.done():
            problem = f"service {served.name} has no open call of this id"
            raise OpError(problem, "answer with the id of the call_service")
        # rosbridge_suite does not look at ``result``, and clients send false with a response that counts.
        if not result and not (isinstance(values, dict) and values):
            text = values if isinstance(values, str) else "the service failed"
            response.set_exception(RmpaError(text[: limits.TEXT_MAX]))
            return
        try:
            response.set_result(served.response.write_arguments(values, self.hub.time.now_ns()).payload)
        except RmpaError as error:
            response.set_exception(error)
            raise

    def _service(self, service: str) -> _Served:
        name = graph_name(service)
        if name not in self._services:
            raise OpError(f"service {name} is not advertised by this client")
        return self._services[name]

    def _asked_for(self, served: _Served, request: bytes, response: asyncio.Future[Payload]) -> None:
        """Pass a call on to the client, or refuse it."""
        try:
            check_count(sum(len(each.calls) for each in self._services.values()), limits.REQUESTS_MAX, "open calls")
            arguments = served.request.json_values(memoryview(request))
        except RmpaError as error:
            response.set_exception(error)
            return
        self._asked += 1
        mid = f"service_request:{served.spelling}:{self._asked}"
        served.calls[mid] = response
        response.add_done_callback(lambda _: served.calls.pop(mid, None))
        op = {"op": "call_service", "id": mid, "service": served.spelling, "args": arguments}
        self.connection.push(encode(op))

    def _service_failed(self, served: _Served, error: RmpaError) -> None:
        del self._services[served.name]
        self.status("error", f"advertise_service {served.name}: {error}")

    def _end_service(self, served: _Served, reason: str) -> None:
        del self._services[served.name]
        served.service.close(reason)


def _fragment_size(size: float | None) -> int | None:
    return None if size is None else whole(size, "fragment_size", 1)


# The fields of each op.
OPS: Final = ops_of(RosbridgeSession, lambda name: name.removesuffix("_"))
