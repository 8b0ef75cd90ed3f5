from __future__ import annotations

import json
import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from rmpa.bridge import limits
from rmpa.bridge.messages import (
    Advertise,
    AdvertiseServices,
    OpenRoute,
    OpenService,
    RouteClosed,
    ServiceClosed,
    ServiceOffer,
    Source,
    TopicOffer,
)
from rmpa.bridge.policy import Names, PermissionGate, Policy
from rmpa.bridge.services.bodies import LocalService
from rmpa.bridge.topics.exports import LocalSource
from rmpa.cli.trust import trust_check
from rmpa.config.peer_rules import Access, Effect, PeerRule, PermissionRule, PolicySettings
from rmpa.config.read import load_settings
from rmpa.config.settings import ServiceSettings, TimeSettings, TrustSettings
from rmpa.core.contract import Contract, Contracts
from rmpa.core.facts import DENIED
from rmpa.core.identity import NEVER_CROSSING
from rmpa.core.statistics import Counters
from rmpa.ros.wire.tcpros import ServiceDescription
from rmpa.trust.permissions import Permissions
from tests.bridge.recorder import (
    EndRoute,
    Exports,
    Imports,
    PeerServiceRules,
    Send,
    ServiceExports,
    ServiceImports,
)
from tests.bridge.test_relay import Map

# Permissions in the plans of topics and services: what is offered, shown, opened and closed by them.


TYPE = "a/B"


def allow(modules: str = "*", **names: str) -> PermissionRule:
    return PermissionRule(tuple(modules.split()), names={key: tuple(globs.split()) for key, globs in names.items()})


def deny(modules: str = "*", **names: str) -> PermissionRule:
    return replace(allow(modules, **names), effect=Effect.DENY)


class Secured:
    """The plans of one secured module, with the links 1 to "joystick" and 2 to "arm"."""

    def __init__(
        self, *rules: PermissionRule, peers: tuple[PeerRule, ...] = (), relays: tuple[str, ...] = ()
    ) -> None:
        self.trust = TrustSettings(rules=rules, relays=relays)
        self.counters = Counters()
        self.gate = PermissionGate(Permissions(self.trust), self.counters)
        self.policy, self.names = Policy(PolicySettings(), peers, TimeSettings("arm")), Names(peers)
        self.rules = PeerServiceRules(ServiceSettings(), self.policy, self.names)
        self.exports = Exports(self.policy, Contracts(), self.names, gate=self.gate)
        self.imports = Imports(self.policy, lambda: 0.5, names=self.names, gate=self.gate)
        self.service_exports = ServiceExports(self.rules, gate=self.gate)
        self.service_imports = ServiceImports(self.rules, gate=self.gate)
        for number, name in ((1, "joystick"), (2, "arm")):
            self.exports.link_up(number, name)
            self.imports.link_up(number, name)
            self.service_exports.link_up(number, name)
            self.service_imports.link_up(number, name, rank=number)

    def publishes(self, *topics: str) -> None:
        for topic in topics:
            self.exports.graph(topic, {"/n": LocalSource(TYPE, "http://127.0.0.1:4000/")})
        self.tell()

    def serves(self, *services: str) -> None:
        for service in services:
            self.service_exports.graph(service, LocalService("/n", "rosrpc://127.0.0.1:4001"))
            self.service_exports.advertise()

    def tell(self) -> list[Any]:
        actions: list[Any] = []
        while self.exports.pending:
            actions += self.exports.advertise()
        return actions

    def told(self, peer: int) -> list[str]:
        return [topic for topic in sorted(s.topic for s in self.exports.offered) if self._told(peer, topic)]

    def _told(self, peer: int, topic: str) -> bool:
        return self.exports.offer(peer, Source(topic, "/n")) is not None

    def shown(self) -> list[tuple[int, str]]:
        return sorted((entry.peer, entry.name) for entry in self.imports if entry.shown)

    def reload(self, *rules: PermissionRule, relays: tuple[str, ...] = ()) -> list[Any]:
        self.gate.reload(TrustSettings(rules=rules, relays=relays))
        actions = self.exports.apply_rules(self.policy, Contracts(), self.names)
        for portion in self.imports.apply_rules(self.policy, Contracts(), self.names, 0.0):
            actions += portion
        return actions


def closed(actions: list[Any]) -> dict[int, str]:
    """The peers that were told of a closed route, and why."""
    return {a.peer: a.message.reason for a in actions if isinstance(a, Send) and isinstance(a.message, RouteClosed)}


def test_who_asks_for_what_it_may_not_have_learns_no_more_than_of_what_is_not_there() -> None:
    here = Secured(allow("joystick", subscribe="/odom"))
    here.publishes("/odom", "/secret")
    answers = []
    for route, topic in enumerate(("/secret", "/nothing"), 1):
        found = closed(here.exports.opened(1, OpenRoute(route, topic, "/n", Contract())))
        answers.append(found[1].replace(topic, "NAME"))
    assert answers[0] == answers[1]
    assert here.counters["permission.subscribe"] >= 2


def test_an_action_crosses_with_all_of_its_topics_or_not_at_all() -> None:
    topics = {name: f"/arm/move/{name}" for name in ("goal", "cancel", "status", "feedback", "result")}
    client = Secured(allow("joystick", action="/arm/move"))
    client.publishes(*(topics[name] for name in ("status", "feedback", "result")), "/arm/move/debug")
    offers = tuple(TopicOffer(topics[name], "/n", TYPE) for name in ("goal", "cancel", "status"))
    client.imports.advertised(1, Advertise(offers, ()))
    assert client.told(1) == sorted(topics[name] for name in ("status", "feedback", "result"))
    assert client.shown() == [(1, topics["cancel"]), (1, topics["goal"])], "it may not speak as the server"
    server = Secured(allow("joystick", action_serve="/arm/move"))
    server.publishes(topics["goal"], topics["cancel"])
    offers = tuple(TopicOffer(topics[name], "/n", TYPE) for name in ("goal", "status", "feedback", "result"))
    server.imports.advertised(1, Advertise(offers, ()))
    assert server.told(1) == [topics["cancel"], topics["goal"]]
    assert server.shown() == [(1, topics[name]) for name in ("feedback", "result", "status")]


def test_only_services_that_a_peer_may_call_are_offered_and_a_reload_ends_its_calls() -> None:
    here = Secured(allow("joystick", call="/stop /go"), deny("joystick", call="/go"))
    here.serves("/stop", "/go")
    assert (here.service_exports.local(1, "/stop"), here.service_exports.local(1, "/go")) == ("/stop", None)
    assert here.service_exports.local(2, "/stop") is None
    refusals = [
        action.message.reason.replace(service, "NAME")
        for service in ("/go", "/nothing")
        for action in here.service_exports.opened(1, OpenService(1, service, 1.0))
        if isinstance(action, Send) and isinstance(action.message, ServiceClosed)
    ]
    assert len(refusals) == 2
    assert refusals[0] == refusals[1]
    server = here.service_exports.offered["/stop"]
    here.service_exports.opened(1, OpenService(3, "/stop", 1.0))
    here.service_exports.described("/stop", server, ServiceDescription("a/Stop", "0" * 32))
    assert here.service_exports.callers("/stop") == (1,)
    here.gate.reload(TrustSettings(rules=(allow("joystick", call="/go"),)))
    actions = [action for portion in here.service_exports.apply_rules(here.rules) for action in portion]
    assert here.service_exports.callers("/stop") == ()
    assert sum(isinstance(action, EndRoute) for action in actions) == 1
    reasons = [a.message.reason for a in actions if isinstance(a, Send) and isinstance(a.message, ServiceClosed)]
    assert reasons == ["the permissions there do not let joystick call /stop"]
    here.service_exports.advertise()
    assert here.service_exports.local(1, "/go") == "/go"


def test_only_services_that_a_peer_may_serve_are_shown_and_another_peer_may_take_the_place() -> None:
    here = Secured(allow("arm", serve="/ik"))
    for peer in (1, 2):
        here.service_imports.advertised(peer, AdvertiseServices((ServiceOffer("/ik", "/n"),), (), full=True))
    first, second = here.service_imports.get(1, "/ik"), here.service_imports.get(2, "/ik")
    assert first is not None
    assert second is not None
    assert (first.shown, first.cause, second.shown) == (False, DENIED, True)
    assert here.service_imports.hidden(first) == "no [[permission]] lets joystick serve /ik"
    assert here.counters["permission.serve"] == 1
    here.gate.reload(TrustSettings(rules=(allow("joystick", serve="/ik"),)))
    for _ in here.service_imports.apply_rules(here.rules):
        pass
    assert (first.shown, second.shown) == (True, False)


# --- whole maps with relays ---------------------------------------------------------------------------------------


class SecuredMap(Map):
    """A map whose modules have permissions, which change."""

    def __init__(self, count: int, relays: set[int], seed: int) -> None:
        trust = TrustSettings(default="allow")
        super().__init__(count, relays, seed, lambda _number: PermissionGate(Permissions(trust)))

    def reload(self, here: int, trust: TrustSettings) -> None:
        module = self.modules[here]
        policy = Policy(PolicySettings())
        rules = PeerServiceRules(ServiceSettings(), policy, Names())
        module.gate.reload(trust)
        self.act(here, module.exports.apply_rules(policy, Contracts(), Names()))
        for actions in module.imports.apply_rules(policy, Contracts(), Names(), 0.0):
            self.act(here, actions)
        for answers in (module.service_exports.apply_rules(rules), module.service_imports.apply_rules(rules)):
            for portion in answers:
                self.act(here, portion)
        self.act(here, module.look())


def test_an_untrusted_relay_does_not_stand_in_the_way_of_a_trusted_one() -> None:
    world = SecuredMap(4, {3, 4}, 1)
    everything = TrustSettings(default="allow")
    world.reload(2, replace(everything, relays=("m4",)))
    for pair in ((1, 3), (1, 4), (2, 3), (2, 4)):
        world.link(*pair)
    world.settle()
    b = world.modules[2]
    assert [(whose.name, via) for whose, via in b.imports.ways] == [("m1", "m4")], "m3 has the lower GUID"
    world.reload(2, replace(everything, relays=("m3",)))
    world.settle()
    assert [(whose.name, via) for whose, via in b.imports.ways] == [("m1", "m3")]
    assert ("/t1", "/rmpa/m1/n") in b.visible()
    world.reload(2, everything)
    world.settle()
    assert ("/t1", "/rmpa/m1/n") not in b.visible()


# What the gate lets pass, counts and logs; and that `rmpa trust check` says the same.


def test_each_refusal_is_counted_and_each_rule_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    counters = Counters()
    gate = PermissionGate(Permissions(TrustSettings()), counters)
    for number in range(50):
        assert not gate.admits(Access.PUBLISH, "arm2", f"/t{number}")
    assert not gate.admits(Access.PUBLISH, "arm3", "/t0")
    assert not gate.admits(Access.CALL, "arm2", "/stop")
    assert counters.as_dict() == {"permission.call": 1, "permission.publish": 51}
    end = " (logged once, then counted) [not-permitted]"
    assert [record.getMessage() for record in caplog.records] == [
        f"! arm2 may not publish /t0: no [[permission]] lets arm2 publish /t0{end}",
        f"! arm3 may not publish /t0: no [[permission]] lets arm3 publish /t0{end}",
        f"! arm2 may not call /stop: no [[permission]] lets arm2 call /stop{end}",
    ]
    gate.reload(TrustSettings())
    assert not gate.admits(Access.CALL, "arm2", "/stop")
    assert len(caplog.records) == 4, "other rules are worth another line"


def test_names_that_are_invented_do_not_fill_the_log(caplog: pytest.LogCaptureFixture) -> None:
    counters = Counters()
    gate = PermissionGate(Permissions(TrustSettings()), counters)
    for number in range(limits.REFUSALS_LOGGED + 10):
        assert not gate.admits(Access.PUBLISH, f"m{number}", "/t")
    assert len(caplog.records) == limits.REFUSALS_LOGGED
    assert counters["permission.publish"] == limits.REFUSALS_LOGGED + 10


def test_a_relay_and_the_origin_are_judged_both(caplog: pytest.LogCaptureFixture) -> None:
    counters = Counters()
    rules = (allow("arm", publish="/arm/**"), allow("relay", publish="/**"))
    gate = PermissionGate(Permissions(TrustSettings(rules=rules, relays=("relay",))), counters)
    assert gate.admits(Access.PUBLISH, "arm", "/arm/state", relay="relay")
    assert not gate.admits(Access.PUBLISH, "leg", "/arm/state", relay="relay"), "the relay's own right is no help"
    assert not gate.admits(Access.PUBLISH, "arm", "/arm/state", relay="spy"), "nor the origin's"
    assert counters.as_dict() == {"permission.publish": 1, "permission.relay": 1}
    assert "trust.relays does not have spy" in caplog.text
    assert "leg may not publish /arm/state by way of relay" in caplog.text


MODULES = ("arm", "arm2", "joystick", "laptop7", "base")


NAMES = ("/cmd_vel", "/joy", "/arm/state", "/arm", "/arm2/state", "/motors/left/on", "/laptop7/log")


GLOBS = ("/**", "/cmd_vel", "/arm/**", "/{peer}/**", "/*/state", "/motors/**", "/arm", "/j?y")


WORDS = [*(str(access) for access in Access), "action", "action_serve"]


def _random_file(rng: random.Random) -> str:
    lines = ["[trust]", f'default = "{rng.choice(("deny", "deny", "allow"))}"', "[trust.groups]"]
    lines += ['operators = ["joystick", "laptop*"]', 'arms = ["arm*"]']
    for _ in range(rng.randint(0, 5)):
        lines += ["[[permission]]", f'effect = "{rng.choice(("allow", "allow", "deny"))}"']
        who = rng.choice(('modules = ["*"]', 'modules = ["arm"]', 'groups = ["operators"]', 'groups = ["arms"]'))
        lines.append(who)
        for word in rng.sample(WORDS, rng.randint(1, 4)):
            lines.append(f"{word} = {json.dumps(rng.sample(GLOBS, rng.randint(1, 2)))}")
    return "\n".join(lines)


@pytest.mark.parametrize("seed", range(25))
def test_trust_check_says_what_is_enforced(seed: int, tmp_path: Path) -> None:
    """For single accesses, the gate itself; for an action, all five topics by the plans' questions."""
    rng = random.Random(seed)
    file = tmp_path / "rmpa.toml"
    file.write_text(_random_file(rng))
    settings = load_settings({"config": str(file)}, {}, host_name="robot", cwd=tmp_path).settings
    gate = PermissionGate(Permissions(settings.trust))
    for _ in range(20):
        module, word, name = rng.choice(MODULES), rng.choice(WORDS), rng.choice(NAMES)
        answer = CliRunner().invoke(trust_check, [module, word, name, "--config", str(file), "--json"])
        if word == "action":
            asked = [(Access.PUBLISH, "goal cancel"), (Access.SUBSCRIBE, "status feedback result")]
        elif word == "action_serve":
            asked = [(Access.SUBSCRIBE, "goal cancel"), (Access.PUBLISH, "status feedback result")]
        else:
            asked = [(Access[word.upper()], "")]
        each = [(access, f"{name}/{one}" if one else name) for access, ones in asked for one in ones.split(" ")]
        enforced = all(gate.admits(access, module, one) for access, one in each)
        assert json.loads(answer.output)["allowed"] is enforced, (module, word, name, file.read_text())
        assert answer.exit_code == (0 if enforced else 1)


@pytest.mark.parametrize(
    ("settings", "topic", "type_name", "node", "allowed", "rule"),
    [
        (PolicySettings(), "/cmd", "sensor_msgs/Joy", "/joy", True, "bridge.allow has '/**'"),
        (PolicySettings(), "/rosout", "rosgraph_msgs/Log", "/joy", False, "built in"),
        (PolicySettings(), "/rosout_agg", "rosgraph_msgs/Log", "/rosout", False, "built in"),
        (PolicySettings(), "/clock", "rosgraph_msgs/Clock", "/gazebo", False, "built in"),
        (PolicySettings(), "/rmpa/quality", "std_msgs/String", "/q", False, "built in"),
        (PolicySettings(), "/cmd", "sensor_msgs/Joy", "/rmpa", False, "the agent itself"),
        (PolicySettings(), "/cmd", "sensor_msgs/Joy", "/rmpa/base/joy", False, "stands for"),
        (PolicySettings(), "/rmpax", "std_msgs/String", "/rmpax", True, "bridge.allow"),
        (PolicySettings(deny=("/camera/**",)), "/camera/image", "a/B", "/n", False, "bridge.deny has"),
        (PolicySettings(deny=("/camera/**",)), "/camera", "a/B", "/n", False, "bridge.deny has"),
        (PolicySettings(deny=("/camera/*",)), "/camera/left/image", "a/B", "/n", True, "bridge.allow"),
        (PolicySettings(deny_types=("sensor_msgs/*",)), "/x", "sensor_msgs/Image", "/n", False, "bridge.deny_types"),
        (PolicySettings(allow_types=("std_msgs/*",)), "/x", "sensor_msgs/Image", "/n", False, "bridge.allow_types"),
        (PolicySettings(allow=("/cmd",)), "/cmd", "a/B", "/n", True, "bridge.allow has '/cmd'"),
        (PolicySettings(allow=("/cmd",)), "/odom", "a/B", "/n", False, "no glob of bridge.allow fits /odom"),
        (PolicySettings(allow=("/**",), deny=("/cmd",)), "/cmd", "a/B", "/n", False, "bridge.deny"),
    ],
)
def test_the_first_no_wins_and_names_its_rule(
    settings: PolicySettings, topic: str, type_name: str, node: str, allowed: bool, rule: str
) -> None:
    decision = Policy(settings).judge(topic, type_name, node)
    assert decision.allowed is allowed
    assert rule in decision.rule


@pytest.mark.trap(36)
def test_no_user_rule_can_open_what_is_built_in() -> None:
    policy = Policy(PolicySettings(allow=tuple(NEVER_CROSSING)))
    assert not any(policy.judge(topic.rstrip("/*"), "a/B", "/n").allowed for topic in NEVER_CROSSING)
