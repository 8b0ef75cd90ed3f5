"""What of services may cross, what it is called, and how long a call may take."""

from __future__ import annotations

from typing import Any

import pytest

from rmpa.bridge.policy import Names, Policy, ServiceRules
from rmpa.config.peer_rules import PeerRule, PolicySettings, ServiceRule
from rmpa.config.settings import ServiceSettings
from rmpa.core.contract import Transport
from tests.bridge.recorder import PeerServiceRules


def rules(settings: ServiceSettings | None = None, peers: tuple[PeerRule, ...] = ()) -> ServiceRules:
    return PeerServiceRules(settings or ServiceSettings(), Policy(PolicySettings(), peers), Names(peers))


def apply_rules(plan: Any, changed: ServiceRules) -> list[Any]:
    """Everything that other rules bring."""
    return [action for portion in plan.apply_rules(changed) for action in portion]


@pytest.mark.parametrize(
    ("settings", "service", "node", "allowed", "rule"),
    [
        (ServiceSettings(), "/add", "/adder", True, "services.allow has '/**'"),
        (ServiceSettings(), "/add", "/rmpa/base/adder", False, "stands for a node of another module"),
        (ServiceSettings(), "/rmpa/get_loggers", "/adder", False, "the agent's own services"),
        (ServiceSettings(), "/adder/get_loggers", "/adder", False, "services.loggers = true"),
        (ServiceSettings(), "/adder/set_logger_level", "/adder", False, "services.loggers = true"),
        (ServiceSettings(loggers=True), "/adder/get_loggers", "/adder", True, "services.allow"),
        (ServiceSettings(deny=("/arm/**",)), "/arm/go", "/arm", False, "services.deny has '/arm/**'"),
        (ServiceSettings(allow=("/arm/**",)), "/add", "/adder", False, "no glob of services.allow fits /add"),
        (ServiceSettings(allow=("/arm/**",), deny=("/arm/stop",)), "/arm/stop", "/arm", False, "services.deny"),
        (ServiceSettings(allow=()), "/add", "/adder", False, "no glob of services.allow"),
    ],
)
def test_each_decision_names_its_rule(
    settings: ServiceSettings, service: str, node: str, allowed: bool, rule: str
) -> None:
    decision = rules(settings).judge(service, node)
    assert decision.allowed is allowed
    assert rule in decision.rule


def test_the_first_rule_that_says_a_transport_gives_it() -> None:
    said = (
        ServiceRule(("/plan/**",), 300.0),
        ServiceRule(("/plan/ik",), transport=Transport.DIRECT),
        ServiceRule(("/**/ik", "/map"), 1.0, Transport.RELAY),
    )
    made = rules(ServiceSettings(transport=Transport.AUTO, rules=said))
    services = ("/add", "/plan/path", "/plan/ik", "/arm/ik")
    assert [made.transport(service) for service in services] == [
        *(Transport.AUTO, Transport.AUTO, Transport.DIRECT, Transport.RELAY)
    ]
    assert [made.timeout(service) for service in services] == [60.0, 300.0, 300.0, 1.0]
    assert [made.has_timeout(service) for service in services] == [False, True, True, True]
    assert rules().transport("/add") is Transport.RELAY
    assert rules(ServiceSettings(timeout=5.0)).has_timeout("/add")
