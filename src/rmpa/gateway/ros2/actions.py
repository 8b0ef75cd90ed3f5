"""Actions: actionlib's of the modules in ROS 2's graph, and ROS 2's in the gateway's graph."""

from __future__ import annotations

import asyncio
import time
from abc import ABC, abstractmethod
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.core.identity import OWN_NODE, proxy_name
from rmpa.gateway import limits
from rmpa.gateway.ros2.format import USUAL_QOS, EntityKind, Ros2Attachment, Ros2Durability, Ros2Endpoint, Ros2Qos
from rmpa.gateway.ros2.goals import GoalsToRos1, GoalsToRos2
from rmpa.gateway.ros2.graph import SITE, valid_name
from rmpa.gateway.ros2.pairs import PART, ActionPair, find_types
from rmpa.gateway.rules import ForeignSource, MeshSource, SourceKind
from rmpa.gateway.zenoh.threads import ZenohQos, ZenohSample
from rmpa.ros.types.definitions import Specification, known_specifications
from rmpa.ros.types.messages import MessageType
from rmpa.runtime.loop import Delay, MachineTimer, SystemClock

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.gateway.foreign import ProxiedTopic
    from rmpa.gateway.own_graph import TopicTap
    from rmpa.gateway.ros2.graph import OwnEndpoint, Publishing, Query
    from rmpa.gateway.ros2.services import Ros2Context
    from rmpa.ros.wire.tcpros import TopicDescription

# Seconds of one goal of an action at a server of ROS 2: a day. A server that dies ends its goals at once.
_ROS2_GOAL_TIMEOUT: Final = 86_400.0
# Seconds for which an action's topics stay in ROS 1's graph once its server is gone: its last results leave.
_ROS2_LAST_RESULTS: Final = 1.0
# Seconds for an action server of ROS 1 to connect to the gateway's topics; then a goal is refused.
_ROS2_ACTION_READY: Final = 5.0

# The node that publishes goals and cancellations for all clients of ROS 2, below ``/rmpa/ros2``.
_NODE: Final = "/action_clients"
_LATCHED: Final = Ros2Qos(durability=Ros2Durability.TRANSIENT_LOCAL, depth=1)
_SEND: Final = f"{PART}send_goal"
_OF_SERVER: Final = ("status", "feedback", "result")
_OF_CLIENTS: Final = ("goal", "cancel")
# The topics of an action of ROS 1, and their types or the ends of their types.
_TYPES: Final = {
    "goal": "ActionGoal",
    "cancel": "actionlib_msgs/GoalID",
    "status": "actionlib_msgs/GoalStatusArray",
    "feedback": "ActionFeedback",
    "result": "ActionResult",
}


class JoinedAction(ABC):
    """An action of one side, as that of a server at the other one.

    Args:
        context: What the parts share.
        name: The action's name in ROS 2.
        here: Its name in the gateway's graph.
        shown: The node that publishes its topics for ROS 1, below ``/rmpa/ros2``.
    """

    def __init__(self, context: Ros2Context, name: str, here: str, shown: str) -> None:
        self.here = here
        self._context = context
        self._name = name
        self._shown = shown
        # Its goals with their timer, once its types are found, and until its server is gone.
        self._goals: GoalsToRos1 | GoalsToRos2 | None = None
        self._timer: MachineTimer | None = None
        self._topics: dict[str, ProxiedTopic] = {}
        self._taps: dict[MeshSource, TopicTap] = {}
        self._declared: list[OwnEndpoint | Publishing] = []
        self._joining = context.start(self._join(), f"join action {name}")

    def close(self) -> None:
        """The server is gone: goals under way end as aborted, and all is taken back but the topics for ROS 1."""
        self._joining.cancel()
        self._context.say(self.here, "")
        goals, self._goals = self._goals, None
        if goals is not None:
            goals.server_gone()
        if self._timer is not None:
            self._timer.close()
        for each in (*self._declared, *self._taps.values()):
            each.close()

    def finish(self) -> None:
        """Take its topics out of ROS 1's graph."""
        for topic in self._topics.values():
            topic.close()
        self._topics.clear()

    def tell_ros1(self, topic: str, message: bytes) -> None:
        """Publish a message for ROS 1."""
        if topic in self._topics:
            self._topics[topic].publish(message)

    @abstractmethod
    async def _join(self) -> None:
        """Find the types, and join the action if they are a pair."""

    def _begin(self, goals: GoalsToRos1 | GoalsToRos2) -> None:
        self._goals = goals
        self._timer = MachineTimer(goals.next_timer, goals.handle_timer)

    def _show(self, part: str, header: TopicDescription, on_demand: Callable[[bool], None]) -> None:
        source = ForeignSource(SourceKind.TOPIC, SITE, "", self._shown, f"{self.here}/{part}", header.type)
        self._topics[part] = self._context.graph.show_topic(source, on_demand)
        self._topics[part].describe(header)

    def _declare(
        self,
        node: str,
        kind: EntityKind,
        part: str,
        types: tuple[str, str],
        qos: Ros2Qos = USUAL_QOS,
        take: Callable[[Any], object] | None = None,
    ) -> OwnEndpoint:
        made = self._context.nodes.declare(node, kind, f"{self._name}{PART}{part}", types, qos, take=take)
        self._declared.append(made)
        return made

    def _tap(self, source: MeshSource, part: str, changed: Callable[[object], None]) -> None:
        """Listen to a topic of ROS 1, as the node that publishes the others."""
        listener = proxy_name(f"{OWN_NODE}/{SITE}", self._shown)
        take = partial(self._take, part)
        self._taps[source] = self._context.graph.tap(source, take, changed, changed, listener=listener)

    def _take(self, part: str, message: Any) -> None:
        """Give a message of a topic to the goals, by the method with its name."""
        if self._goals is not None:
            try:
                getattr(self._goals, part)(message)
            except RmpaError as error:
                self._context.say(f"{self.here} (messages)", str(error))
            self._arm()

    def _arm(self) -> None:
        if self._goals is not None and self._timer is not None:
            self._timer.arm()


class OfferedAction(JoinedAction):
    """Offers one actionlib server to ROS 2.

    Args:
        context: What the parts share.
        name: The action's name in the gateway's graph, and in ROS 2.
        ros1: ``package/Name`` of the action.
        server: The server's topics by *status*, *feedback* and *result*.
    """

    def __init__(self, context: Ros2Context, name: str, ros1: str, server: Mapping[str, MeshSource]) -> None:
        super().__init__(context, name, name, _NODE)
        self.ros1 = ros1
        self.server = dict(server)
        self._connected: set[str] = set()
        self._ready = asyncio.Event()
        self._publishers: dict[str, tuple[Publishing, bytes]] = {}
        self._sequence = 0

    def close(self) -> None:
        """The server is gone: goals under way end as aborted, and all is taken back."""
        super().close()
        self.finish()

    def tell_ros2(self, topic: str, message: bytes) -> None:
        """Publish a message for ROS 2."""
        publisher, gid = self._publishers[topic]
        self._sequence += 1
        publisher.put_all([(message, Ros2Attachment(self._sequence, time.time_ns(), gid).serialize())])

    def answer(self, query: Query, response: bytes) -> None:
        """Answer a request of a client; its attachment is repeated, as rmw_zenoh does."""
        try:
            asked = Ros2Attachment.parse(query.attachment)
        except RmpaError as error:
            query.reply_error(str(error))
            return
        query.reply(response, Ros2Attachment(asked.sequence, time.time_ns(), asked.gid).serialize())

    async def _join(self) -> None:
        context = self._context
        if not valid_name(self._name):
            context.say(self.here, "ROS 2 does not allow the name of this action")
            return
        try:
            rule = context.pairs.mapping.counterpart(self.ros1, "action")
            pair = ActionPair(await ActionPair.find(self.ros1), rule, context.types)
            topics = await find_types(f"{self.ros1}ActionGoal", "actionlib_msgs/GoalID")
        except RmpaError as error:
            context.say(self.here, f"ROS 2 does not see this action: {error}")
            return
        self._begin(GoalsToRos1(self, pair, SystemClock()))
        for part, kind in zip(_OF_CLIENTS, topics, strict=True):
            self._show(part, kind.describe(), partial(self._demand, part))
        node = self.server["result"].proxy
        for part, qos, cache in (("feedback", USUAL_QOS, 0), ("status", _LATCHED, 1)):
            made = self._declare(node, EntityKind.PUBLISHER, part, pair.types[part], qos)
            publisher = context.session.publisher(made.endpoint.key(), ZenohQos(cache=cache), _ignore)
            self._declared.append(publisher)
            self._publishers[part] = publisher, made.gid
        for part in ("send_goal", "get_result", "cancel_goal"):
            take = self._send_goal if part == "send_goal" else partial(self._request, part)
            self._declare(node, EntityKind.SERVICE, part, pair.types[part], take=take)

    def _demand(self, part: str, wanted: bool) -> None:
        (self._connected.add if wanted else self._connected.discard)(part)
        self._judge_ready()

    def _judge_ready(self) -> None:
        """Whether the server hears goals: its topics are listened to, and it listens to ours."""
        heard = [tap for tap in self._taps.values() if tap.description is not None]
        whole = len(heard) == len(_OF_SERVER) and len(self._connected) == len(_OF_CLIENTS)
        (self._ready.set if whole else self._ready.clear)()

    def _changed(self, _value: object) -> None:
        asyncio.get_running_loop().call_soon(self._judge_ready)

    def _send_goal(self, query: Query) -> None:
        """Listen to the server from the first goal on, and pass the goal on once the server listens too."""
        for part, source in self.server.items():
            if source not in self._taps:
                self._tap(source, part, self._changed)
        self._judge_ready()
        self._context.start(self._send_when_ready(query), f"goal of {self._name}")

    async def _send_when_ready(self, query: Query) -> None:
        try:
            async with asyncio.timeout(_ROS2_ACTION_READY):
                await self._ready.wait()
        except TimeoutError:
            query.reply_error("the action server of ROS 1 does not listen to goals")
            return
        self._request("send_goal", query)

    def _request(self, service: str, query: Query) -> None:
        if self._goals is None:
            query.reply_error("the action server of ROS 1 is gone")
            return
        try:
            getattr(self._goals, service)(query)
        except RmpaError as error:
            query.reply_error(str(error))
        self._arm()


class ShownAction(JoinedAction):
    """Shows one action server of ROS 2 to actionlib's clients.

    Args:
        context: What the parts share.
        server: The server's endpoint *send_goal*.
        name: The action's name in ROS 2.
        here: Its name in the gateway's graph.
    """

    def __init__(self, context: Ros2Context, server: Ros2Endpoint, name: str, here: str) -> None:
        super().__init__(context, name, here, server.node.name)
        self.server = server
        self._clients: set[MeshSource] = set()
        # What the gateway declares for its clients, by part.
        self._callers: dict[str, OwnEndpoint] = {}
        self._types: dict[str, tuple[str, str]] = {}
        self._leaving = Delay()

    def follow(self, clients: set[MeshSource]) -> None:
        """The topics *goal* and *cancel* of its clients are these now."""
        self._clients = clients
        if self._goals is None:
            return
        for source in self._taps.keys() - clients:
            self._taps.pop(source).close()
        for source in clients - self._taps.keys():
            self._tap(source, source.here.rpartition("/")[2], _ignore)
        for part in ("feedback", "status") if clients else ():  # from the first client on
            self._caller(EntityKind.SUBSCRIPTION, part, partial(self._sample, part))

    def close(self) -> None:
        """The server is gone: goals under way end as aborted, then the topics go."""
        super().close()
        # The last results have to leave before their publishers.
        self._leaving.set(_ROS2_LAST_RESULTS, self.finish)

    def finish(self) -> None:
        """Take its topics out of the graph, once it is closed."""
        self._leaving.cancel()
        super().finish()

    def ask(self, service: str, uuid: bytes, request: bytes) -> None:
        """Call a service of the server, and tell the goals what comes of it."""
        if self._goals is not None:
            self._context.start(self._ask(service, uuid, request), f"ask {service}")

    async def _join(self) -> None:
        context, server = self._context, self.server
        ros2 = server.type.removesuffix("_SendGoal")
        asked = (
            ("send_goal", EntityKind.SERVICE),
            ("get_result", EntityKind.SERVICE),
            ("feedback", EntityKind.PUBLISHER),
        )
        endpoints = [(f"{self._name}{PART}{part}", kind) for part, kind in asked]
        try:
            pair = await context.find_pair(server, ros2, ActionPair, *endpoints)
            headers = [kind.describe() for kind in await find_types("actionlib_msgs/GoalStatusArray")]
            headers += await self._outcome_headers(pair)
        except RmpaError as error:
            context.say(self.here, f"the action of ROS 2's node {server.node.name} is not shown: {error}")
            return
        self._types = pair.types
        goals = GoalsToRos2(self, pair, SystemClock())
        self._begin(goals)

        def wanted(there: bool) -> None:
            goals.show_status(wanted=there)
            self._arm()

        for part, header in zip(_OF_SERVER, headers, strict=True):
            self._show(part, header, wanted if part == "status" else _ignore)
        self.follow(self._clients)

    @staticmethod
    async def _outcome_headers(pair: ActionPair) -> list[TopicDescription]:
        """The headers of an action's feedback and result; made where this machine has no definition."""
        try:
            kinds = await find_types(f"{pair.ros1}ActionFeedback", f"{pair.ros1}ActionResult")
        except RmpaError:
            return [_wrapped(pair.ros1, "Feedback", pair.feedback.ros1), _wrapped(pair.ros1, "Result", pair.result)]
        return [kind.describe() for kind in kinds]

    def _caller(self, kind: EntityKind, part: str, take: Callable[[ZenohSample], None] | None = None) -> OwnEndpoint:
        """What the gateway declares for all clients, once."""
        if part not in self._callers:
            node = self._context.nodes.own_name
            self._callers[part] = self._declare(node, kind, part, self._types[part], take=take)
        return self._callers[part]

    def _sample(self, part: str, sample: ZenohSample) -> None:
        self._take(part, sample.payload)

    async def _ask(self, service: str, uuid: bytes, request: bytes) -> None:
        within = _ROS2_GOAL_TIMEOUT if service == "get_result" else limits.ROS2_CALL_TIMEOUT
        answer = await self._caller(EntityKind.CLIENT, service).call(request, within)
        goals = self._goals
        if not isinstance(goals, GoalsToRos2):
            return  # its server has gone meanwhile
        try:
            if answer is None or not answer.ok:
                text = answer.text if answer is not None else "it is gone"
                raise RemoteProtocolError(f"the action server of ROS 2 gave no answer to {service}: {text}")
            goals.answered(service, uuid, answer.payload)
        except RmpaError as error:
            goals.failed(service, uuid, str(error))
        self._arm()


def _wrapped(ros1: str, part: str, kind: MessageType) -> TopicDescription:
    """The message of actionlib around a feedback or result, as its genaction.py makes it."""
    name = f"{ros1}Action{part}"
    text = f"Header header\nactionlib_msgs/GoalStatus status\n{kind.name} {part.lower()}\n"
    known = {**known_specifications("std_msgs/Header"), **known_specifications("actionlib_msgs/GoalStatus")}
    return MessageType(name, {**known, **kind.specifications, name: Specification.parse(name, text)}).describe()


def _ignore(_value: object) -> None:
    """Nothing is to be done."""


class Ros2Actions:
    """Joins actions both ways."""

    def __init__(self, context: Ros2Context) -> None:
        self._context = context
        # The topics of servers and clients of ROS 1 by action, and what part each is.
        self._topics: dict[str, dict[MeshSource, str]] = {}
        self._offered: dict[str, OfferedAction] = {}
        self._shown: dict[str, ShownAction] = {}
        # Actions whose server is gone, the last of each name: their topics stay for a moment.
        self._leaving: dict[str, ShownAction] = {}

    @staticmethod
    def takes(source: MeshSource) -> bool:
        """Whether a source of a module is a topic of an action."""
        name, _, part = source.here.rpartition("/")
        return bool(name) and source.kind is SourceKind.TOPIC and source.type.endswith(_TYPES.get(part, "\0"))

    def mesh_source(self, source: MeshSource, *, there: bool) -> None:
        """Take a topic of an action."""
        name, _, part = source.here.rpartition("/")
        topics = self._topics.setdefault(name, {})
        if there:
            topics[source] = part
        else:
            topics.pop(source, None)
        if part in _OF_SERVER:
            self._offer(name)
        for shown in self._shown.values():
            if shown.here == name and part in _OF_CLIENTS:
                shown.follow(self._clients(name))
        if not topics:
            del self._topics[name]

    def endpoint(self, endpoint: Ros2Endpoint, *, there: bool) -> None:
        """Take a service or topic of an action; its *send_goal* stands for the server."""
        if endpoint.kind is EntityKind.SERVICE and endpoint.name.endswith(_SEND):
            name = endpoint.name.removesuffix(_SEND)
            shown = self._shown.get(name)
            if there and shown is None:
                self._show(name, endpoint)
            elif not there and shown is not None and shown.server == endpoint:
                shown.close()
                self._leaving[name] = self._shown.pop(name)
                # The next server of this name takes its place.
                if (other := next(self._context.ros2.at(endpoint.name, EntityKind.SERVICE), None)) is not None:
                    self._show(name, other)

    def close(self) -> None:
        """Take back all actions of both sides."""
        for action in (*self._offered.values(), *self._shown.values()):
            action.close()
        for shown in (*self._shown.values(), *self._leaving.values()):
            shown.finish()
        self._offered.clear()
        self._shown.clear()

    def _clients(self, name: str) -> set[MeshSource]:
        return {source for source, part in self._topics.get(name, {}).items() if part in _OF_CLIENTS}

    def _offer(self, name: str) -> None:
        """Offer the first server of a name that has all its topics."""
        servers: dict[str, dict[str, MeshSource]] = {}
        for source, part in self._topics[name].items():
            if part in _OF_SERVER:
                servers.setdefault(source.proxy, {})[part] = source
        whole = [parts for parts in servers.values() if len(parts) == len(_OF_SERVER)]
        if name in self._offered and self._offered[name].server not in whole:
            self._offered.pop(name).close()
        if name in self._offered or not whole or len(self._offered) >= limits.ROS2_ACTIONS_MAX:
            return
        result = whole[0]["result"]
        ros1 = result.type.removesuffix("ActionResult")
        if ros1.endswith("/"):
            return  # no action has such a name
        if self._context.rules.outgoing_to(SITE, result.module, result.name).allowed:
            self._offered[name] = OfferedAction(self._context, name, ros1, whole[0])

    def _show(self, name: str, endpoint: Ros2Endpoint) -> None:
        if len(self._shown) >= limits.ROS2_ACTIONS_MAX:
            return
        if (before := self._leaving.pop(name, None)) is not None:
            before.finish()
        source = ForeignSource(SourceKind.SERVICE, SITE, "", endpoint.node.name, name, "*")
        decision = self._context.rules.incoming(source)
        if decision.allowed:
            self._shown[name] = ShownAction(self._context, endpoint, name, decision.name)
            self._shown[name].follow(self._clients(decision.name))
