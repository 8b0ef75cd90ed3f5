"""What the node tf2_web_republisher does for roslib's TFClient, done for one client, where no such node runs.

A client names a target frame and source frames, and gets the transforms between them: no faster than its rate, and
only those that have moved by more than its thresholds. It asks in one of the ways of tf2_web_republisher:

* the service ``/republish_tfs``, which returns the name of a topic;
* the action ``/tf2_web_republisher`` of actionlib, by its topics ``goal``, ``cancel``, ``feedback``, ``status``;
* the same action by rosbridge's own messages (``send_action_goal``), as for ROS 2.

Nothing of it is in the ROS graph. A real node goes first, wherever in the mesh it runs.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.installed import ServiceType
from rmpa.web.hub.node_link import Follower
from rmpa.web.hub.params import ros_time
from rmpa.web.hub.topics import ReceivedMessage
from rmpa.web.hub.transforms import Transform, frame_name
from rmpa.web.rosbridge import limits
from rmpa.web.rosbridge.protocol import Id, OpError, check_count

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.core.errors import RmpaError
    from rmpa.web.hub.connection import Session

ACTION: Final = "/tf2_web_republisher"
SERVICE: Final = "/republish_tfs"
SERVICE_TYPE: Final = "tf2_web_republisher/RepublishTFs"
_GOAL, _CANCEL, _FEEDBACK, _STATUS, _RESULT = (
    f"{ACTION}/{each}" for each in ("goal", "cancel", "feedback", "status", "result")
)
_ARRAY: Final = "tf2_web_republisher/TFArray"
_PACKAGE: Final = "tf2_web_republisher/TFSubscription"
_TYPES: Final = {
    _GOAL: f"{_PACKAGE}ActionGoal",
    _CANCEL: "actionlib_msgs/GoalID",
    _FEEDBACK: f"{_PACKAGE}ActionFeedback",
    _STATUS: "actionlib_msgs/GoalStatusArray",
    _RESULT: f"{_PACKAGE}ActionResult",
}
_RATE: Final = 10.0  # of a request without one, as roslib's
# States of actionlib_msgs/GoalStatus.
_ACTIVE, _PREEMPTED = 1, 2
Values: TypeAlias = dict[str, Any]


@dataclass(slots=True, eq=False)
class _Request:
    """What a client wants to have sent again and again.

    ``send`` gets a list of geometry_msgs/TransformStamped; ``timeout`` is in seconds, for a request whose topic has
    no subscriber.
    """

    frames: list[str]
    target: str
    angle: float
    distance: float
    period: float
    due: float
    send: Callable[[list[Values]], None]
    topic: str = ""
    timeout: float = math.inf
    unheard: float = 0.0
    sent: dict[str, Transform] = field(default_factory=dict)


class TfRepublisher:
    """The requests of one client.

    Args:
        client: The client; what it may subscribe to binds this, too.
    """

    def __init__(self, client: Session) -> None:
        self._client = client
        # By the way in which each was made, and its name in that.
        self._requests: dict[tuple[str, str], _Request] = {}
        self._streams: dict[Follower, tuple[str, Callable[[ReceivedMessage], None]]] = {}
        self._follower: Follower | None = None
        self._numbers = itertools.count()

    def serves(self, service: str) -> bool:
        """Whether a call of a service is answered here."""
        return service == SERVICE and service not in self._client.hub.graph.services

    def publishes(self, topic: str) -> bool:
        """Whether a topic that a client subscribes to comes from here."""
        return topic in {each.topic for each in self._requests.values()} or (
            topic in (_FEEDBACK, _STATUS, _RESULT) and not self._has_server()
        )

    def takes(self, topic: str) -> bool:
        """Whether what a client publishes on a topic is meant for this."""
        return topic in (_GOAL, _CANCEL) and not self._has_server()

    def _has_server(self) -> bool:
        known = self._client.hub.graph.topics.get(_FEEDBACK)
        return known is not None and bool(known.publishers)

    def subscribe(self, topic: str, receive: Callable[[ReceivedMessage], None]) -> Follower:
        """Subscribe to a topic of ``publishes``."""
        return Follower(self._streams, (topic, receive))

    def call(self, arguments: Any, now: float) -> Values:
        """Answer ``/republish_tfs``."""
        wanted = _read(ServiceType(SERVICE_TYPE).request, arguments)
        name = f"{ACTION}/tf_repub_{next(self._numbers)}"
        request = self._begin(
            ("topic", name), wanted, now, lambda rows: self._push(name, _ARRAY, {"transforms": rows})
        )
        seconds = wanted["timeout"]["secs"] + wanted["timeout"]["nsecs"] * 1e-9
        request.topic, request.timeout = name, min(max(seconds, limits.TF_TIMEOUT_MIN), limits.TF_TIMEOUT_MAX)
        request.unheard = now
        return {"topic_name": name}

    def publish(self, topic: str, message: Any, now: float) -> None:
        """Take a goal of actionlib, or the end of one, or of all if it has no id."""
        values = _read(self._client.hub.types.message(_TYPES[topic]), message)
        if topic == _CANCEL:
            for key in [("goal", values["id"])] if values["id"] else [*self._requests]:
                if key[0] == "goal":
                    self.cancel(*key)
            return
        goal_id = values["goal_id"]

        def send(rows: list[Values]) -> None:
            self._push(_FEEDBACK, _TYPES[_FEEDBACK], {"status": _status(goal_id), "feedback": {"transforms": rows}})

        self._begin(("goal", goal_id["id"]), values["goal"], now, send)
        self._push(_STATUS, _TYPES[_STATUS], {"status_list": [_status(goal_id)]})

    def send_goal(self, action: str, goal: Id, arguments: Any, now: float, push: Callable[[Values], None]) -> None:
        """Begin a goal of rosbridge's own messages; ``push`` sends one to the client.

        Raises:
            OpError: It is of another action, or there are too many.
        """
        _check_action(action)

        def send(rows: list[Values]) -> None:
            push({"op": "action_feedback", "action": action, "id": goal, "values": {"transforms": rows}})

        wanted = _read(self._client.hub.types.message(f"{_PACKAGE}Goal"), arguments)
        self._begin(("action", str(goal)), wanted, now, send)

    def cancel_goal(self, action: str, goal: Id) -> list[Values]:
        """End it; the messages for the client, with the status CANCELED of action_msgs/GoalStatus."""
        _check_action(action)
        ended: Values = {
            "op": "action_result",
            "action": action,
            "id": goal,
            "values": {},
            "status": 5,
            "result": True,
        }
        return [ended] if self.cancel("action", str(goal)) else []

    def cancel(self, way: str, name: str) -> bool:
        """End a request; returns whether there was one.

        Args:
            way: ``topic``, ``goal`` (of actionlib) or ``action`` (of rosbridge's own messages).
            name: Of the topic or goal.
        """
        there = self._requests.pop((way, name), None)
        if there is not None and way == "goal":
            status = _status({"id": name}, _PREEMPTED)
            self._push(_STATUS, _TYPES[_STATUS], {"status_list": [status]})
            self._push(_RESULT, _TYPES[_RESULT], {"status": status})
        self._rest()
        return there is not None

    def next_timer(self) -> float | None:
        """When something is due."""
        return min((each.due for each in self._requests.values()), default=None)

    def handle_timer(self, now: float) -> None:
        """Send what has moved."""
        for key, request in [*self._requests.items()]:
            if request.due > now:
                continue
            request.due = max(request.due + request.period, now)
            if request.topic and not any(topic == request.topic for topic, _ in self._streams.values()):
                if now - request.unheard >= request.timeout:
                    self.cancel(*key)
                continue
            request.unheard = now
            if rows := self._moved(request):
                request.send(rows)

    def close(self) -> None:
        """The client has gone."""
        self._requests.clear()
        self._rest()

    def _begin(
        self, key: tuple[str, str], wanted: Values, now: float, send: Callable[[list[Values]], None]
    ) -> _Request:
        check_count(len(self._requests), limits.TF_REQUESTS_MAX, "requests for transforms")
        if len(wanted["source_frames"]) > limits.TF_FRAMES_MAX:
            raise OpError(f"{len(wanted['source_frames'])} source frames are more than {limits.TF_FRAMES_MAX}")
        if self._follower is None:
            self._follower = self._client.hub.transforms.follow(self._failed)
        rate = wanted["rate"] or 0.0
        period = 1 / min(rate if rate > 0 else _RATE, limits.TF_RATE_MAX)
        frames = [*dict.fromkeys(map(frame_name, wanted["source_frames"]))]
        angle, distance = wanted["angular_thres"] or 0.0, wanted["trans_thres"] or 0.0
        request = _Request(frames, frame_name(wanted["target_frame"]), angle, distance, period, now, send)
        self._requests[key] = request
        return request

    def _moved(self, request: _Request) -> list[Values]:
        tree, rows = self._client.hub.transforms, []
        stamp = ros_time(self._client.hub.time.now_ns())
        for frame in request.frames:
            place, last = tree.lookup(request.target, frame), request.sent.get(frame)
            if place is None or (
                last is not None
                and min(request.distance, request.angle) > 0
                and place.distance(last) <= request.distance
                and place.angle(last) <= request.angle
            ):
                continue
            request.sent[frame] = place
            header = {"stamp": stamp, "frame_id": request.target}
            rows.append({"header": header, "child_frame_id": frame, "transform": place.values()})
        return rows

    def _push(self, topic: str, type_: str, values: Values) -> None:
        hub = self._client.hub
        receivers = [receive for name, receive in self._streams.values() if name == topic]
        if receivers:
            now_ns = hub.time.now_ns()
            payload = codec_for(hub.types.message(type_)).write(values, now_ns).payload
            message = ReceivedMessage(topic, type_, memoryview(payload), now_ns)
            for receive in receivers:
                receive(message)

    def _rest(self) -> None:
        if self._follower is not None and not self._requests:
            self._follower.close()
            self._follower = None
            self._client.hub.transforms.rest()

    def _failed(self, error: RmpaError) -> None:
        self._requests.clear()
        self._rest()
        self._client.warn(f"{ACTION}: {error}", "tf")


def _check_action(action: str) -> None:
    if action != ACTION:
        problem = f"the action {action[:80]!a} is not one of rosbridge's own messages here"
        raise OpError(problem, f"{ACTION} is; others are actionlib's topics: ROSLIB.ActionClient")


def _status(goal_id: Mapping[str, Any], state: int = _ACTIVE) -> Values:
    return {"goal_id": goal_id, "status": state}


def _read(kind: Any, values: Any) -> Values:
    """The fields of a message of a client: all are there, and of their types."""
    codec = codec_for(kind)
    read: Values = codec.json_values(memoryview(codec.write_arguments(values, 0).payload))
    return read
