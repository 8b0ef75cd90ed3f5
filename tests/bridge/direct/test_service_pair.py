"""Both sides of direct calls back to back, in every order that hypothesis finds."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from hypothesis import given, settings
from hypothesis import strategies as st

from rmpa.bridge import limits
from rmpa.bridge.direct.client_side import (
    AnswerDirect,
    AnswerRelay,
    AskPeer,
    DirectServices,
    Lost,
    ProbeServer,
    ReleaseGrant,
    ServiceAction,
    ServiceKey,
)
from rmpa.bridge.direct.conditions import Condition, Grant, Unmet
from rmpa.bridge.direct.server_side import CloseDirect, RetryDirect, ServiceGrants
from rmpa.bridge.direct.subscriber_side import DirectState
from rmpa.core.contract import Transport

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.bridge.direct.server_side import ServerAction

NAMES = ("/a", "/b")
RULE = Unmet(Condition.TRANSPORT, "relay")
CLOSED = Unmet(Condition.LISTENING, "loopback only")


class World:
    """A calling and a serving module, the wires between them, and the servers."""

    def __init__(self) -> None:
        self.services, self.grants = DirectServices(), ServiceGrants()
        self.now, self.linked, self.port = 0.0, True, 1000
        self.ports = dict.fromkeys(NAMES, 0)
        """Where each server listens for the network; 0: on loopback only."""
        self.uris = dict.fromkeys(NAMES, "")
        self.allowed = dict.fromkeys(NAMES, True)
        self.wanted = dict.fromkeys(NAMES, True)
        self.to_server: deque[AskPeer | ReleaseGrant] = deque()
        self.to_client: deque[tuple[AskPeer, Grant | Unmet] | ServerAction] = deque()
        self.probes: deque[ProbeServer] = deque()
        self.answers: dict[str, int] = {}
        for name in NAMES:
            self.restart(name)
            self.consider(name)

    def act(self, actions: Sequence[ServiceAction]) -> None:
        for action in actions:
            match action:
                case AskPeer() | ReleaseGrant():
                    if self.linked:
                        self.to_server.append(action)
                case ProbeServer():
                    self.probes.append(action)
                case AnswerDirect(key, grant):
                    assert key.service not in self.answers
                    self.answers[key.service] = grant.port
                case AnswerRelay(key):
                    del self.answers[key.service]
                case Lost(key):
                    self.act(self.services.remove(key))
                case _:
                    raise AssertionError(action)

    def tell(self, actions: Sequence[ServerAction]) -> None:
        if self.linked:
            self.to_client.extend(actions)

    # --- what happens -------------------------------------------------------------------------------------------

    def consider(self, name: str) -> None:
        unmet = None if self.wanted[name] else Unmet(Condition.NAME, "renamed")
        self.act(self.services.consider(ServiceKey(1, name), "/n", Transport.AUTO, unmet, self.now))

    def restart(self, name: str) -> None:
        self.port += 1
        self.ports[name] = 0 if self.port % 5 == 0 else self.port
        self.uris[name] = f"rosrpc://10.0.0.1:{self.port}"
        self.tell(self.grants.server(name, "/n", self.uris[name]))

    def change_rule(self, name: str) -> None:
        self.allowed[name] = not self.allowed[name]
        self.tell(self.grants.judge_again(lambda service, _peer: None if self.allowed[service] else RULE))

    def change_name(self, name: str) -> None:
        self.wanted[name] = not self.wanted[name]
        self.consider(name)

    def lose(self, _name: str, *, crashed: bool = False) -> None:
        if self.linked:
            self.linked = False
            self.to_server.clear()
            self.to_client.clear()
            self.grants.peer_gone(1)
            self.act(self.services.link_down(1, self.now, crashed=crashed))
            assert crashed or not self.answers

    def crash(self, name: str) -> None:
        self.lose(name, crashed=True)

    def link(self, _name: str = "") -> None:
        if not self.linked:
            self.linked = True
            self.act(self.services.link_up(1))
            for name in NAMES:
                self.consider(name)

    def ask(self, _name: str = "") -> None:
        if self.to_server:
            asked = self.to_server.popleft()
            if isinstance(asked, ReleaseGrant):
                self.grants.released(1, asked.key.service, asked.node)
                return
            name = asked.key.service
            found: Grant | Unmet = Grant(self.ports[name], "/n") if self.ports[name] else CLOSED
            if not self.allowed[name]:
                found = RULE
            self.grants.answered(1, name, "/n", self.uris[name], found)
            self.to_client.append((asked, found))

    def reply(self, _name: str = "") -> None:
        if self.to_client:
            match self.to_client.popleft():
                case (AskPeer() as asked, found):
                    self.act(self.services.replied(asked.key, asked.attempt, found, self.now))
                case CloseDirect(_, service, node, unmet):
                    self.act(self.services.closed(ServiceKey(1, service), node, unmet, self.now))
                case RetryDirect(_, service, node):
                    self.act(self.services.retry(ServiceKey(1, service), node))

    def probe(self, _name: str = "") -> None:
        if self.probes:
            probe = self.probes.popleft()
            problem = "" if self.ports[probe.key.service] == probe.grant.port else "refused"
            self.act(self.services.probed(probe.key, probe.attempt, problem, self.now))

    def wait(self, _name: str = "") -> None:
        self.now += limits.DIRECT_RETRY
        self.act(self.services.handle_timer(self.now))

    def settle(self) -> None:
        """Everything under way arrives, and passing problems are tried again."""
        self.link()
        for _ in range(4):
            while self.to_server or self.to_client or self.probes:
                self.ask()
                self.reply()
                self.probe()
            self.wait()
        while self.to_server or self.to_client or self.probes:
            self.ask()
            self.reply()
            self.probe()


EVENTS = ("restart", "change_rule", "change_name", "lose", "crash", "link", "ask", "reply", "probe", "wait")


@settings(max_examples=400, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(EVENTS), st.sampled_from(NAMES)), max_size=60))
def test_in_the_end_lookups_are_answered_with_where_the_server_listens(events: list[tuple[str, str]]) -> None:
    world = World()
    for event, name in events:
        getattr(world, event)(name)
        for service, port in world.answers.items():
            known = world.services.get(ServiceKey(1, service))
            assert known is not None
            assert (known.state, known.grant) == (DirectState.DIRECT, Grant(port, "/n"))
    world.settle()
    for name in NAMES:
        expected = world.ports[name] if world.allowed[name] and world.wanted[name] else 0
        assert world.answers.get(name, 0) == expected, name
        assert world.grants.peers(name) == ((1,) if expected else ()), "no grant is left that is not used"
