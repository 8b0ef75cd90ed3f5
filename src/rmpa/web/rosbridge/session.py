"""One rosbridge client: frames and the hub's answers in, frames and requests to the hub out. No I/O, no clock."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from rmpa.core.errors import RmpaError
from rmpa.web.hub.requests import (
    Answer,
    Failed,
    HubRequest,
    OtherType,
    ParamsChanged,
    ReceivedMessage,
    ServiceFound,
    ServiceRequest,
    ServiceResult,
)
from rmpa.web.rosbridge import limits, protocol
from rmpa.web.rosbridge.calls import Calls
from rmpa.web.rosbridge.context import LEVELS, SessionContext
from rmpa.web.rosbridge.encodings import PublishFrames, decode_png
from rmpa.web.rosbridge.fragments import Assembler
from rmpa.web.rosbridge.protocol import Id, OpError, Part, RosbridgeFrame, id_of, parse_frame, parse_op
from rmpa.web.rosbridge.publications import Publications
from rmpa.web.rosbridge.rosapi import Rosapi
from rmpa.web.rosbridge.served import RosbridgeServedServices
from rmpa.web.rosbridge.subscriptions import Subscriptions

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.web.hub.types import TypeLibrary
    from rmpa.web.rosbridge.rosapi import HubGraph


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
