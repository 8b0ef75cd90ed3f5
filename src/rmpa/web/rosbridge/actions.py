"""ROS 2's ops for actions, for servers of actionlib: a goal is published, feedback and result come from topics.

The client sees a ROS 2 action: ``action_feedback`` and one ``action_result`` with a status of
``action_msgs/GoalStatus``. Clients that offer actions themselves get an error status.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import RmpaError
from rmpa.web.hub.requests import (
    AdvertiseTopic,
    PublishMessage,
    ReceivedMessage,
    Subscribe,
    UnadvertiseTopic,
    Unsubscribe,
)
from rmpa.web.rosbridge import limits
from rmpa.web.rosbridge.context import Style, check_count
from rmpa.web.rosbridge.encodings import Compression
from rmpa.web.rosbridge.protocol import Id, OpError, graph_name, type_name
from rmpa.web.values.codec import MessageCodec, codec_for

if TYPE_CHECKING:
    from rmpa.web.hub.requests import Failed
    from rmpa.web.rosbridge import protocol
    from rmpa.web.rosbridge.context import SessionContext

_CANCELED, _ABORTED, _SUCCEEDED = 5, 6, 4
_STATUSES: Final = {2: _CANCELED, 3: _SUCCEEDED, 4: _ABORTED, 5: _ABORTED, 8: _CANCELED, 9: _ABORTED}
"""Statuses of ROS 2 by those of ROS 1: preempted, succeeded, aborted, rejected, recalled and lost."""
_CANCEL_TYPE: Final = "actionlib_msgs/GoalID"


@dataclass(slots=True)
class _Goal:
    mid: Id
    style: Style
    feedback: bool


@dataclass(slots=True)
class _Action:
    """An action with open goals, by the id of their messages; `spelling` is as the client writes its name."""

    name: str
    spelling: str
    type: str
    goal: MessageCodec
    codecs: dict[int, tuple[str, MessageCodec]]
    """What the hub's subscriptions carry: ``result`` or ``feedback``."""
    publishers: dict[str, int]
    goals: dict[str, _Goal] = field(default_factory=dict)


class Actions:
    """All goals of a client that are open.

    Args:
        context: The session.
        client: Makes the ids of goals unique among all clients.
    """

    def __init__(self, context: SessionContext, client: str) -> None:
        self._context = context
        self._client = client
        self._actions: dict[str, _Action] = {}
        self._sent = 0

    def send_goal(self, op: protocol.SendActionGoal) -> None:
        """Send a goal; each ends with one ``action_result``, unless the op is refused at once.

        Raises:
            OpError: The action or its type is none, or too many goals are open.
            DefinitionError: The messages of the action are not known.
            MessageError: The arguments do not fit.
        """
        name, kind = graph_name(op.action), type_name(op.action_type)
        style = Style.parse(op.compression, op.fragment_size)
        check_count(sum(len(each.goals) for each in self._actions.values()), limits.GOALS_MAX, "open goals")
        action = self._actions.get(name)
        if action is not None and action.type != kind:
            raise OpError(f"{name} has the type {action.type}, not {kind}")
        codec = action.goal if action is not None else self._codec(f"{kind}ActionGoal")
        now_ns = self._context.ros_time_ns()
        arguments = codec_for(self._context.types.message(f"{kind}Goal")).write_arguments(op.args, now_ns)
        self._sent += 1
        goal_id = f"{self._client}-{self._sent}-{now_ns}"
        # A goal is the last field of its message, so its bytes are those of the message's end.
        head = codec.write({"goal_id": {"stamp": "now", "id": goal_id}}, now_ns).payload
        empty = codec_for(self._context.types.message(f"{kind}Goal")).write({}, now_ns).payload
        payload = head[: len(head) - len(empty)] + arguments.payload
        if action is None:
            action = self._begin(name, op.action, kind, codec)
        action.goals[goal_id] = _Goal(op.id, style, op.feedback)
        self._context.ask(PublishMessage(action.publishers["goal"], payload))

    def cancel_goal(self, op: protocol.CancelActionGoal) -> None:
        """Ask the server to cancel a goal; its ``action_result`` follows.

        Raises:
            OpError: No such goal is open.
        """
        action = self._actions.get(graph_name(op.action))
        goals = action.goals.items() if action is not None else ()
        found = next((goal_id for goal_id, goal in goals if goal.mid == op.id), None)
        if action is None or found is None:
            raise OpError(f"no goal of this id is open for {op.action[: limits.NAME_MAX]}")
        # A stamp of zero: only the goal of this id, not all before a time.
        cancel = self._codec(_CANCEL_TYPE).write({"stamp": {"secs": 0, "nsecs": 0}, "id": found}, 0)
        self._context.ask(PublishMessage(action.publishers["cancel"], cancel.payload))

    def receive(self, message: ReceivedMessage) -> bool:
        """Take a message of the hub; False if it is of no action here."""
        for action in self._actions.values():
            if message.handle in action.codecs:
                part, codec = action.codecs[message.handle]
                try:
                    self._take(action, part, codec, message.payload)
                except RmpaError as error:
                    self._context.status("error", f"{part} of {action.name}: {error}")
                return True
        return False

    def _take(self, action: _Action, part: str, codec: MessageCodec, payload: memoryview) -> None:
        values = codec.json_values(payload)
        status = values["status"]
        goal_id = status["goal_id"]["id"]
        goal = action.goals.get(goal_id)
        if goal is None or (part == "feedback" and not goal.feedback):
            return  # of another client's goal
        if goal.style.compression >= Compression.CBOR:
            values = codec.cbor_values(payload)
        op = {"op": f"action_{part}", "action": action.spelling, "values": values[part]}
        if part == "result":
            code = _STATUSES.get(status["status"], 0)
            op |= {"status": code, "result": code == _SUCCEEDED}
            self._end_goal(action, goal_id)
        self._send(goal, op)

    def fail(self, failed: Failed) -> bool:
        """The hub cannot serve an action's topic; False if it is none of these."""
        for action in list(self._actions.values()):
            if failed.handle in action.codecs or failed.handle in action.publishers.values():
                problem = str(OpError(failed.error, failed.remedy))
                for goal_id, goal in list(action.goals.items()):
                    self._end_goal(action, goal_id)
                    op = {"op": "action_result", "action": action.spelling, "values": problem}
                    self._send(goal, op | {"status": _ABORTED, "result": False})
                return True
        return False

    def close(self) -> None:
        """Forget all goals; their servers go on with them, as with a client of actionlib that ends."""
        for action in list(self._actions.values()):
            self._end(action)

    def _send(self, goal: _Goal, op: dict[str, Any]) -> None:
        self._context.send_op(op if goal.mid is None else op | {"id": goal.mid}, goal.style, goal.mid)

    def _codec(self, kind: str) -> MessageCodec:
        return codec_for(self._context.types.message(kind))

    def _begin(self, name: str, spelling: str, kind: str, goal: MessageCodec) -> _Action:
        ask, new = self._context.ask, self._context.new_handle
        parts = {part: self._codec(f"{kind}Action{part.title()}") for part in ("result", "feedback")}
        codecs = {new(): (part, codec) for part, codec in parts.items()}
        action = _Action(name, spelling, kind, goal, codecs, {"goal": new(), "cancel": new()})
        for handle, (part, codec) in codecs.items():
            ask(Subscribe(handle, f"{name}/{part}", codec.name))
        # Latched, so that a server gets the goal that connects after it was sent; it ends with the last open goal.
        ask(AdvertiseTopic(action.publishers["goal"], f"{name}/goal", goal.name, latch=True))
        ask(AdvertiseTopic(action.publishers["cancel"], f"{name}/cancel", _CANCEL_TYPE))
        self._actions[name] = action
        return action

    def _end_goal(self, action: _Action, goal_id: str) -> None:
        del action.goals[goal_id]
        if not action.goals:
            self._end(action)

    def _end(self, action: _Action) -> None:
        del self._actions[action.name]
        for handle in action.codecs:
            self._context.ask(Unsubscribe(handle))
        for handle in action.publishers.values():
            self._context.ask(UnadvertiseTopic(handle))
