"""What both directions of actions share: finding the types, and the way of messages to the goals."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final, Generic, Protocol, TypeVar

from rmpa.core.errors import RmpaError
from rmpa.gateway.neighbour import ForeignSource, SourceKind
from rmpa.gateway.ros2.action_pair import PART, ActionPair
from rmpa.gateway.ros2.attachment import Ros2Attachment
from rmpa.gateway.ros2.conversion import NoConversion
from rmpa.gateway.ros2.crossing import SITE
from rmpa.gateway.ros2.derived import derive_ros1
from rmpa.gateway.ros2.qos import Ros2Qos
from rmpa.gateway.ros2.tokens import EntityKind
from rmpa.ros.types.definitions import Specification, known_specifications
from rmpa.ros.types.find import find_message_type
from rmpa.ros.types.messages import MessageType
from rmpa.runtime.loop import MachineTimer, SystemClock

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rmpa.gateway.graph.foreign_topic import ProxiedTopic
    from rmpa.gateway.graph.taps import TopicTap
    from rmpa.gateway.ros2.io.own_nodes import OwnEndpoint
    from rmpa.gateway.ros2.io.part import Ros2Context
    from rmpa.gateway.ros2.mapping import ActionRule
    from rmpa.gateway.ros2.tokens import Ros2Endpoint
    from rmpa.gateway.zenoh.session import Declaration
    from rmpa.ros.wire.tcpros import TopicDescription

_PARTS: Final = ("Goal", "Result", "Feedback")


class ActionGoals(Protocol):
    """The goals of one action, in one direction."""

    pair: ActionPair

    def server_gone(self) -> None:
        """The server is gone: all goals end as aborted."""

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is to be called; ``None``: not."""

    def handle_timer(self, now: float) -> None:
        """Do what is due."""


_Goals = TypeVar("_Goals", bound=ActionGoals)


class JoinedAction(Generic[_Goals]):
    """An action of one side, as that of a server at the other one.

    Args:
        context: What the parts share.
        name: The action's name in ROS 2.
        here: Its name in the gateway's graph.
        server: The server's node in the gateway's graph or ROS 2's.
        shown: The node that publishes its topics for ROS 1, below ``/rmpa/ros2``.
    """

    def __init__(self, context: Ros2Context, name: str, here: str, server: str, shown: str) -> None:
        self.here = here
        self._context = context
        self._name = name
        self._server = server
        self._shown = shown
        self._clock = SystemClock()
        self._goals: _Goals | None = None
        self._timer: MachineTimer | None = None
        self._topics: dict[str, ProxiedTopic] = {}
        self._declared: list[Declaration | OwnEndpoint] = []
        self._sequence = 0
        self._closed = False

    def start(self) -> None:
        """Find the types, and join it if they are a pair."""
        self._context.spawn(self._join())

    def close(self) -> None:
        """The server is gone: goals under way end as aborted."""
        self._closed = True
        self._context.say(self.here, "")
        if self._goals is not None:
            self._goals.server_gone()
        if self._timer is not None:
            self._timer.close()
        for each in self._declared:
            each.close()

    def tell_ros1(self, topic: str, message: bytes) -> None:
        """Publish a message for ROS 1."""
        if topic in self._topics:
            self._topics[topic].publish(message)

    async def _join(self) -> None:
        raise NotImplementedError

    def _begin(self, goals: _Goals) -> None:
        self._goals = goals
        self._timer = MachineTimer(goals.next_timer, goals.handle_timer)

    def _show(self, header: TopicDescription, part: str, on_demand: Callable[[bool], None]) -> None:
        source = ForeignSource(SourceKind.TOPIC, SITE, "", self._shown, f"{self.here}/{part}", header.type)
        self._topics[part] = self._context.graph.show_topic(source, on_demand)
        self._topics[part].describe(header)

    def _declare(self, node: str, kind: EntityKind, part: str, qos: Ros2Qos | None = None) -> OwnEndpoint:
        assert self._goals is not None  # noqa: S101 - nothing is declared before
        name, types = f"{self._name}{PART}{part}", self._goals.pair.types[part]
        made = self._context.nodes.declare(node, kind, name, *types, qos or Ros2Qos())
        self._declared.append(made)
        return made

    def _tap(self, source: Any, part: str, changed: Callable[[object], None]) -> TopicTap:
        """Listen to a topic of ROS 1, as the node that publishes the others."""
        listener = f"/rmpa/{SITE}{self._shown}"
        return self._context.graph.tap(source, self._take(part), changed, changed, listener=listener)

    def _take(self, part: str) -> Callable[[Any], None]:
        """What takes the messages of a topic: the method of the goals with its name."""

        def take(message: Any) -> None:
            if self._goals is None or self._closed:
                return
            try:
                getattr(self._goals, part)(message)
            except RmpaError as error:
                self._context.say(f"{self.here} (messages)", str(error))
            self._arm()

        return take

    def _arm(self) -> None:
        if self._timer is not None and not self._closed:
            self._timer.arm()

    def _attachment(self, gid: bytes) -> bytes:
        self._sequence += 1
        return Ros2Attachment(self._sequence, self._clock.wall_ns(), gid).serialize()


async def find_parts(name: str) -> list[MessageType]:
    """Find goal, result and feedback of ``package/Name``.

    Raises:
        RmpaError: A definition is missing.
    """
    return [await asyncio.to_thread(find_message_type, f"{name}{part}") for part in _PARTS]


async def learn_action(
    context: Ros2Context, server: Ros2Endpoint, ros1: str, rule: ActionRule, known: Sequence[MessageType] = ()
) -> ActionPair:
    """Make the pair of an action from what the node of its server in ROS 2 says of its types.

    Args:
        context: What the parts share.
        server: The server's endpoint *send_goal*.
        ros1: ``package/Name`` of ROS 1.
        rule: ``package/action/Name`` of ROS 2, and fields if a mapping file lists them.
        known: Goal, result and feedback of ROS 1 if this machine has them; else they are derived.

    Raises:
        RmpaError: The node does not describe them, or the types are no pair.
    """
    name = server.name.removesuffix(f"{PART}send_goal")
    fields = await context.asker.learn(
        (server.name, EntityKind.SERVICE),
        (f"{name}{PART}get_result", EntityKind.SERVICE),
        (f"{name}{PART}feedback", EntityKind.PUBLISHER),
        of=server,
    )
    types = context.types.variant(fields)
    own = {f"{rule.name}_{part}": f"{ros1}{part}" for part in _PARTS}
    try:
        kinds = known or [
            derive_ros1(types.store, each, lambda it: own.get(it) or context.ros1_name(it)) for each in own
        ]
        return ActionPair(kinds, rule, types)
    except KeyError as error:
        raise NoConversion(f"{rule.name} has no form in ROS 1: {error}") from error


async def find_headers(*kinds: str) -> list[TopicDescription]:
    """The headers of topics of types that this machine knows.

    Raises:
        RmpaError: A definition is missing.
    """
    return [(await asyncio.to_thread(find_message_type, kind)).describe() for kind in kinds]


async def outcome_headers(pair: ActionPair) -> list[TopicDescription]:
    """The headers of an action's feedback and result; made where this machine has no definition."""
    try:
        return await find_headers(f"{pair.ros1}ActionFeedback", f"{pair.ros1}ActionResult")
    except RmpaError:
        return [_wrapped(pair, "Feedback", pair.feedback.ros1), _wrapped(pair, "Result", pair.result)]


def _wrapped(pair: ActionPair, part: str, kind: MessageType) -> TopicDescription:
    """The message of actionlib around a feedback or result, as its genaction.py makes it."""
    name = f"{pair.ros1}Action{part}"
    text = f"Header header\nactionlib_msgs/GoalStatus status\n{kind.name} {part.lower()}\n"
    known = {**known_specifications("std_msgs/Header"), **known_specifications("actionlib_msgs/GoalStatus")}
    return MessageType(name, {**known, **kind.specifications, name: Specification.parse(name, text)}).describe()
