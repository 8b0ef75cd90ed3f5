"""A copy of the graph of a master that is another program; it marks the agent's own registrations.

It has two sources: the agent's own registrations, which count at once, and surveys, which show those of others. A
survey also shows own registrations that the master lacks (it was restarted), and leftovers that have to be
unregistered (an agent was killed, or a call was lost).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeAlias

from rmpa.ros.master.effects import GraphChange, RegistrationKind
from rmpa.ros.master.registrations import ANY_TYPE, Registrations
from rmpa.ros.wire.xmlrpc import RosReply, XmlRpcValue, brief

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rmpa.core.counters import Yielder
    from rmpa.ros.master.survey import Survey

Call: TypeAlias = tuple[str, tuple[XmlRpcValue, ...]]
"""A method of the Master API and its parameters."""
Entry: TypeAlias = tuple[RegistrationKind, str, str]
"""One registration: its kind, the topic, service or parameter, and the node."""

REGISTRATIONS: Final = {
    "registerPublisher": (RegistrationKind.PUBLISHER, 4),
    "registerSubscriber": (RegistrationKind.SUBSCRIBER, 4),
    "registerService": (RegistrationKind.SERVICE, 4),
    "subscribeParam": (RegistrationKind.PARAM, 3),
    "unregisterPublisher": (RegistrationKind.PUBLISHER, 3),
    "unregisterSubscriber": (RegistrationKind.SUBSCRIBER, 3),
    "unregisterService": (RegistrationKind.SERVICE, 3),
    "unsubscribeParam": (RegistrationKind.PARAM, 3),
}
"""The methods that ``Mirror.apply`` accepts: what they register, and the number of their parameters."""


@dataclass(frozen=True, slots=True)
class _Own:
    """One registration of the agent: the call, the node's slave API, and the call that unregisters it."""

    call: Call
    api: str
    undo: Call


class Mirror:
    """The copy of the graph of one master.

    Args:
        yielder: Iterates, and serves pending data in between, in surveys of thousands of topics.
    """

    def __init__(self, *, yielder: Yielder = iter) -> None:
        self._yielder = yielder
        self.registrations = Registrations()
        self._own: dict[Entry, _Own] = {}
        # Registrations changed by ``apply`` since the last survey began, with the number of that call: the survey may
        # not show the change yet.
        self._touched: dict[Entry, int] = {}
        self._asked = 0
        # Nodes whose registrations the master has although nothing listens at their address any more.
        self._dead: dict[str, str] = {}
        # Nodes that the previous run of the master knew and the present one lacks: they may live, and their
        # connections go on.
        self._orphans: dict[str, str] = {}
        self._run = ""

    # --- questions --------------------------------------------------------------------------------------------

    @property
    def asked(self) -> int:
        """Count of calls of ``apply``: a survey that begins now shows the effect of these."""
        return self._asked

    @property
    def dead(self) -> Mapping[str, str]:
        """Nodes that were found dead, and their slave APIs."""
        return self._dead

    def is_ours(self, node: str) -> bool:
        """Whether the agent registered something for this node."""
        return any(entry[2] == node for entry in self._own)

    def others(self) -> dict[str, str]:
        """The nodes that are not the agent's, with their slave APIs."""
        ours = {node for _, _, node in self._own}
        return {node: api for node, api in self.registrations.nodes().items() if node not in ours}

    def unregister_calls(self) -> list[Call]:
        """The calls that unregister all that the agent registered, the latest registration first."""
        return [own.undo for own in reversed(self._own.values())]

    def take_changes(self) -> list[GraphChange]:
        """Return the changes since the previous call of this method."""
        self.registrations.effects.clear()  # the master notifies the nodes
        changes, self.registrations.changes = self.registrations.changes, []
        return changes

    # --- the agent's own registrations ------------------------------------------------------------------------

    def apply(self, method: str, params: Sequence[XmlRpcValue]) -> RosReply:
        """Apply a call of the agent, one of ``REGISTRATIONS``, to the copy; the caller sends it to the master.

        Returns:
            The answer that the copy gives in place of the master.
        """
        self._asked += 1
        words = [param for param in params if isinstance(param, str)]
        kind, arity = REGISTRATIONS[method]
        if not len(words) == len(params) == arity:
            return RosReply(-1, f"{method} does not take {brief(params)}", 0)
        return self._unregister(kind, words) if method.startswith("un") else self._register(kind, method, words)

    def _register(self, kind: RegistrationKind, method: str, words: list[str]) -> RosReply:
        value: XmlRpcValue = 1
        match kind, words:
            case RegistrationKind.PUBLISHER, [node, key, type_name, api]:
                self.registrations.register_publisher(key, type_name, node, api)
                undo: Call = "unregisterPublisher", (node, key, api)
                value = self.registrations.apis(RegistrationKind.SUBSCRIBER, key)
            case RegistrationKind.SUBSCRIBER, [node, key, type_name, api]:
                self.registrations.register_subscriber(key, type_name, node, api)
                undo = "unregisterSubscriber", (node, key, api)
                value = self.registrations.apis(RegistrationKind.PUBLISHER, key)
            case RegistrationKind.SERVICE, [node, key, uri, api]:
                self.registrations.register_service(key, uri, node, api)
                undo = "unregisterService", (node, key, uri)
            case _, [node, api, key]:
                undo = "unsubscribeParam", (node, api, key)
            case _:
                raise AssertionError(words)
        self._touched[kind, key, node] = self._asked
        self._own[kind, key, node] = _Own((method, tuple(words)), api, undo)
        return RosReply(1, "will be registered", value)

    def _unregister(self, kind: RegistrationKind, words: list[str]) -> RosReply:
        node, key = (words[0], words[2]) if kind is RegistrationKind.PARAM else (words[0], words[1])
        self._touched[kind, key, node] = self._asked
        own = self._own.get((kind, key, node))
        if own is None or own.undo[1] != tuple(words):
            return RosReply(1, f"{node} is not registered for {key}", 0)
        self._forget(kind, key, node)
        return RosReply(1, "will be unregistered", 1)

    def forget(self, call: Call) -> None:
        """Drop a registration of the agent's that the master refused."""
        for entry, own in list(self._own.items()):
            if own.call == call:
                self._forget(*entry)

    def _forget(self, kind: RegistrationKind, key: str, node: str) -> None:
        own = self._own.pop((kind, key, node))
        if kind is RegistrationKind.SERVICE:
            self.registrations.unregister_service(key, str(own.undo[1][2]), node)
        elif kind is not RegistrationKind.PARAM:
            self.registrations.unregister(kind, key, node, own.api)

    # --- the others -------------------------------------------------------------------------------------------

    def mark_dead(self, node: str, api: str) -> None:
        """Remove a dead node from the copy, and ignore the registrations that the master still has of it."""
        self._dead[node] = api
        self._orphans.pop(node, None)
        self.registrations.purge(node, api)

    def mark_alive(self, node: str) -> None:
        """Undo ``mark_dead``: the next survey shows the node again."""
        self._dead.pop(node, None)

    def taken(self, survey: Survey, node: str, seen: int) -> str:
        """The slave API that a node of the agent has at the master, if another agent has registered it there.

        Args:
            survey: The survey.
            node: The node.
            seen: ``asked`` when the survey began.
        """
        ours = {
            own.api for entry, own in self._own.items() if entry[2] == node and self._touched.get(entry, 0) <= seen
        }
        there = survey.uris.get(node, "")
        return there if ours and there not in ours else ""

    def update(self, survey: Survey, seen: int) -> list[Call]:
        """Apply a survey to the copy.

        Args:
            survey: The survey, in which every node and service that still exists was looked up.
            seen: ``asked`` when the survey began.

        Returns:
            Calls that register what the master lacks of the agent's registrations, and unregister those of the
            agent's nodes that the agent does not have.
        """
        if self._run and survey.run != self._run:
            # Nodes do not register at a restarted master until they restart themselves, but their connections go on.
            # They stay in the copy, so that the routes to and from them go on too.
            self._orphans |= self.others()
        again = [] if survey.run == self._run else self._own_params()
        self._run = survey.run
        listed = survey.nodes()
        self._orphans = {node: api for node, api in self._orphans.items() if node not in listed}
        self._dead = {node: api for node, api in self._dead.items() if survey.uris.get(node) == api}
        ours = {node for _, _, node in self._own}
        passed = {*ours, *self._dead}
        for kind, table in survey.holders.items():
            self._drop_gone(kind, table, ours, passed, survey)
        for kind, table in survey.holders.items():
            self._add_new(kind, table, passed, survey, seen)
        self._update_types(survey, passed)
        again += self._missing(survey, seen)
        again += self._surplus(survey, seen)
        self._touched = {entry: asked for entry, asked in self._touched.items() if asked > seen}
        return again

    def _own_params(self) -> list[Call]:
        """Calls that subscribe to parameters; no survey shows these, so a restarted master gets all of them again."""
        return [own.call for (kind, _, _), own in self._own.items() if kind is RegistrationKind.PARAM]

    def _drop_gone(
        self,
        kind: RegistrationKind,
        table: Mapping[str, Sequence[str]],
        ours: set[str],
        passed: set[str],
        survey: Survey,
    ) -> None:
        for key, nodes in self._yielder(self.registrations.providers(kind)):
            there = table.get(key, ())
            for node, api in nodes.items():
                # A survey showed what a node of ours had before, while it had no registration by which it was known.
                leftover = node in ours and (kind, key, node) not in self._own
                if not leftover and (node in passed or self._orphans.get(node) == api):
                    continue
                if leftover or node not in there or survey.uris.get(node) != api:
                    if kind is RegistrationKind.SERVICE:
                        uri = self.registrations.service_uri(key)
                        self.registrations.unregister_service(key, uri or "", node)
                    else:
                        self.registrations.unregister(kind, key, node, api)

    def _add_new(
        self, kind: RegistrationKind, table: Mapping[str, Sequence[str]], passed: set[str], survey: Survey, seen: int
    ) -> None:
        for key, nodes in self._yielder(table.items()):
            for node in nodes:
                api = survey.uris.get(node)
                if node in passed or api is None:
                    continue
                known = self.registrations.at(kind, key).get(node) == api
                match kind:
                    case RegistrationKind.PUBLISHER if not known:
                        self.registrations.register_publisher(key, survey.types.get(key, ANY_TYPE), node, api)
                    case RegistrationKind.SUBSCRIBER if not known:
                        self.registrations.register_subscriber(key, survey.types.get(key, ANY_TYPE), node, api)
                    case RegistrationKind.SERVICE if key in survey.services:
                        self._take_service(key, survey.services[key], node, api, seen)

    def _take_service(self, service: str, uri: str, node: str, api: str, seen: int) -> None:
        if self.registrations.service_uri(service) == uri and node in self.registrations.at(
            RegistrationKind.SERVICE, service
        ):
            return
        for ours in tuple(self.registrations.at(RegistrationKind.SERVICE, service)):
            entry = RegistrationKind.SERVICE, service, ours
            if entry in self._own:
                if self._touched.get(entry, 0) > seen:
                    return
                # The last provider of a service counts: the agent's was replaced, and is not registered again.
                self._forget(*entry)
        self.registrations.register_service(service, uri, node, api)

    def _update_types(self, survey: Survey, passed: set[str]) -> None:
        """Update the types of topics: the master has the type that was registered last."""
        types = self.registrations.types()
        for topic, type_name in self._yielder(survey.types.items()):
            if types.get(topic) == type_name or type_name == ANY_TYPE:
                continue
            for node, api in self.registrations.at(RegistrationKind.PUBLISHER, topic).items():
                if node not in passed:
                    self.registrations.register_publisher(topic, type_name, node, api)
            if topic not in types and (nodes := self.registrations.at(RegistrationKind.SUBSCRIBER, topic)):
                node, api = next(iter(nodes.items()))
                self.registrations.register_subscriber(topic, type_name, node, api)

    def _missing(self, survey: Survey, seen: int) -> list[Call]:
        again = []
        for (kind, key, node), own in self._yielder(list(self._own.items())):
            if kind is RegistrationKind.PARAM or self._touched.get((kind, key, node), 0) > seen:
                continue
            there = node in survey.holders[kind].get(key, ()) and survey.uris.get(node) == own.api
            if not there or (kind is RegistrationKind.SERVICE and survey.services.get(key) != own.undo[1][2]):
                again.append(own.call)
        return again

    def _surplus(self, survey: Survey, seen: int) -> list[Call]:
        """Calls that unregister what the master has of the agent's nodes and the agent does not have."""
        ours = {node: own.api for (_, _, node), own in self._own.items()}
        nodes = {node: api for node, api in ours.items() if survey.uris.get(node) == api}
        again: list[Call] = []
        for kind, table in survey.holders.items():
            for key, holders in self._yielder(table.items()):
                for node in holders:
                    if (
                        node not in nodes
                        or (kind, key, node) in self._own
                        or self._touched.get((kind, key, node), 0) > seen
                    ):
                        continue
                    match kind:
                        case RegistrationKind.PUBLISHER:
                            again.append(("unregisterPublisher", (node, key, nodes[node])))
                        case RegistrationKind.SUBSCRIBER:
                            again.append(("unregisterSubscriber", (node, key, nodes[node])))
                        case _:
                            again.append(("unregisterService", (node, key, survey.services.get(key, ""))))
        return again
