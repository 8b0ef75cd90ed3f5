"""Actions: actionlib's of the modules in ROS 2's graph, and ROS 2's in the gateway's graph."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.ros2.action_pair import PART, action_name
from rmpa.gateway.ros2.io.offered_action import OfferedAction
from rmpa.gateway.ros2.io.shown_action import ShownAction
from rmpa.gateway.ros2.tokens import EntityKind

if TYPE_CHECKING:
    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.ros2.io.part import Ros2Context
    from rmpa.gateway.ros2.tokens import Ros2Endpoint

_SEND: Final = f"{PART}send_goal"
_PARTS: Final = {
    "goal": "ActionGoal",
    "cancel": "actionlib_msgs/GoalID",
    "status": "actionlib_msgs/GoalStatusArray",
    "feedback": "ActionFeedback",
    "result": "ActionResult",
}
"""The topics of an action of ROS 1, and their types or the ends of their types."""
_OF_SERVER: Final = ("status", "feedback", "result")


class Ros2Actions:
    """Joins actions both ways. It takes all topics and services of actions, so that no other part carries them."""

    def __init__(self, context: Ros2Context) -> None:
        self._context = context
        self._servers: dict[str, dict[str, dict[str, MeshSource]]] = {}
        """The topics of servers of ROS 1 by action, node and part."""
        self._clients: dict[str, list[MeshSource]] = {}
        """The topics of clients of ROS 1 by action."""
        self._offered: dict[str, OfferedAction] = {}
        self._shown: dict[str, ShownAction] = {}
        self._leaving: dict[str, ShownAction] = {}
        """Actions whose server is gone, the last of each name: their topics stay for a moment."""

    def mesh_source(self, source: MeshSource, *, there: bool) -> bool:
        """Take a topic of an action."""
        name, _, part = source.here.rpartition("/")
        if source.kind is not SourceKind.TOPIC or not name or not source.type.endswith(_PARTS.get(part, "\0")):
            return False
        if part in _OF_SERVER:
            self._server_changed(name, part, source, there=there)
        else:
            self._client_changed(name, source, there=there)
        return True

    def endpoint(self, endpoint: Ros2Endpoint, *, there: bool) -> bool:
        """Take a service or topic of an action; its *send_goal* stands for the server."""
        if PART not in endpoint.name:
            return False
        if endpoint.kind is EntityKind.SERVICE and endpoint.name.endswith(_SEND):
            name = endpoint.name.removesuffix(_SEND)
            shown = self._shown.get(name)
            if there and shown is None:
                self._show(name, endpoint)
            elif not there and shown is not None and shown.server == endpoint:
                shown.close()
                self._leaving[name] = self._shown.pop(name)
                self._show_other(name)
        return True

    def close(self) -> None:
        """Take back all actions of both sides."""
        for offered in self._offered.values():
            offered.close()
        for shown in self._shown.values():
            shown.close()
        for shown in (*self._shown.values(), *self._leaving.values()):
            shown.finish()
        self._offered.clear()
        self._shown.clear()

    def report(self) -> dict[str, object]:
        """Nothing: what is wrong with one is among the problems."""
        return {}

    # --- inside -----------------------------------------------------------------------------------------------------

    def _server_changed(self, name: str, part: str, source: MeshSource, *, there: bool) -> None:
        nodes = self._servers.setdefault(name, {})
        parts = nodes.setdefault(source.proxy, {})
        if there:
            parts[part] = source
        elif parts.get(part) == source:
            del parts[part]
        offered = self._offered.get(name)
        if offered is not None and offered.server["result"].proxy == source.proxy and len(parts) < len(_OF_SERVER):
            self._offered.pop(name).close()
        if not parts:
            del nodes[source.proxy]
        if not nodes:
            del self._servers[name]
        self._offer(name)

    def _offer(self, name: str) -> None:
        whole = [parts for parts in self._servers.get(name, {}).values() if len(parts) == len(_OF_SERVER)]
        if name in self._offered or not whole or len(self._offered) >= limits.ROS2_ACTIONS_MAX:
            return
        result = whole[0]["result"]
        ros1 = action_name(result.type, "ActionResult")
        if self._context.crossing.outgoing(result.module, result.name).allowed and ros1:
            self._offered[name] = OfferedAction(self._context, name, ros1, whole[0])
            self._offered[name].start()

    def _client_changed(self, name: str, source: MeshSource, *, there: bool) -> None:
        clients = self._clients.setdefault(name, [])
        if there:
            clients.append(source)
        elif source in clients:
            clients.remove(source)
        if not clients:
            del self._clients[name]
        for shown in self._shown.values():
            if shown.here == name:
                shown.client(source, there=there)

    def _show(self, name: str, endpoint: Ros2Endpoint) -> None:
        if len(self._shown) >= limits.ROS2_ACTIONS_MAX:
            return
        if (before := self._leaving.pop(name, None)) is not None:
            before.finish()
        decision = self._context.crossing.incoming(SourceKind.SERVICE, name, "*", endpoint.node.name)
        if decision.allowed:
            self._shown[name] = shown = ShownAction(self._context, endpoint, name, decision.name)
            shown.start()
            for source in self._clients.get(decision.name, ()):
                shown.client(source, there=True)

    def _show_other(self, name: str) -> None:
        """The server is gone: the next of this name takes its place."""
        if (other := next(self._context.ros2.at(name + _SEND, EntityKind.SERVICE), None)) is not None:
            self._show(name, other)
