"""``rmpa why`` of a service: each stage by itself."""

from __future__ import annotations

import re
from dataclasses import replace

import msgspec
import pytest

from rmpa.observe.peer_info import Check, CheckLevel
from rmpa.observe.snapshot import ServiceInfo
from rmpa.observe.why.diagnosis import Diagnosis, ServiceAtServer
from rmpa.observe.why.services import ServiceHere, diagnose_service

BEGIN = (Check("peer", CheckLevel.OK, "known"), Check("link", CheckLevel.OK, "linked"))
THERE = ServiceAtServer(node="/arm", service="/move", rule="services.allow has '/**'")
INFO = ServiceInfo(name="/move", node="/arm", direction="in", peer="robot", calls=3)
HERE = ServiceHere(INFO, registered=True, answer="a/Move, md5 123")
ORDER = ("peer", "link", "server", "policy there", "offer", "shown", "graph", "transport", "answer", "calls")


def walk(
    here: ServiceHere = HERE, there: ServiceAtServer | None = THERE, begin: tuple[Check, ...] = BEGIN
) -> Diagnosis:
    refusal = "" if there else "it is older"
    return diagnose_service(begin, "base", "robot", "/move", "/move", here, there, refusal)


def told(**changes: object) -> ServiceHere:
    """What is known here, with other facts in the snapshot."""
    return replace(HERE, info=msgspec.structs.replace(INFO, **changes))


def test_a_service_that_can_be_called() -> None:
    found = walk()
    assert found.flows
    assert (found.kind, found.name, found.peer, found.to, found.node) == ("service", "/move", "robot", "base", "/arm")
    assert tuple(stage.name for stage in found.stages) == ORDER
    assert found.stages[-1].text == "3 from here, 0 of them failed"
    assert msgspec.convert(msgspec.to_builtins(found), Diagnosis) == found


LOOPBACK = {"condition": "listening", "relayed_because": "on loopback only"}


@pytest.mark.parametrize(
    ("facts", "level", "text"),
    [
        ({}, CheckLevel.OK, 'transport is "relay" here'),
        ({"wanted": "auto", "address": "rosrpc://10.0.0.1:9"}, CheckLevel.OK, "direct: .* at rosrpc://10.0.0.1:9"),
        ({"wanted": "direct"}, CheckLevel.OK, "robot is being asked"),
        ({"wanted": "auto", **LOOPBACK}, CheckLevel.OK, "relayed.*listening.*only"),
        ({"wanted": "direct", **LOOPBACK}, CheckLevel.WARN, "although .*listening.*only"),
    ],
    ids=["by rule", "direct", "asked", "auto", "direct in vain"],
)
def test_the_transport_is_named_with_its_condition(facts: dict[str, str], level: CheckLevel, text: str) -> None:
    found = walk(told(**facts))
    assert found.flows
    [stage] = [stage for stage in found.stages if stage.name == "transport"]
    assert stage.level is level
    assert re.search(text, stage.text)


FAILURES: dict[str, tuple[ServiceHere, ServiceAtServer | None, str, str, str]] = {
    "nobody provides it": (HERE, ServiceAtServer(), "server", "no node of robot provides /move", "start its server"),
    "nearly its name": (HERE, ServiceAtServer(similar="/mov"), "server", "no node", "did you mean /mov?"),
    "its server is stuck": (
        HERE,
        msgspec.structs.replace(THERE, refusal="no answer within 2 s"),
        "server",
        "/arm on robot is registered for it, and does not answer: no answer within 2 s",
        "rosnode ping /arm",
    ),
    "an older agent": (ServiceHere(), None, "server", "it is older", "rosservice info /move"),
    "policy there": (
        HERE,
        msgspec.structs.replace(THERE, crosses=False, rule="services.deny has '/move'"),
        "policy there",
        "services.deny has '/move'",
        "rmpa.toml of robot",
    ),
    "not offered yet": (ServiceHere(), THERE, "offer", "has not come here", "both logs"),
    "policy here": (
        told(hidden="policy: services.deny has '/move'"),
        THERE,
        "shown",
        "services.deny has '/move'",
        "rmpa reload",
    ),
    "another provider": (
        told(hidden="/local of this module provides it itself"),
        THERE,
        "shown",
        "/local of this module",
        "another name",
    ),
    "not registered": (replace(HERE, registered=False), THERE, "graph", "does not have it", "5 s"),
    "no answer": (
        replace(HERE, answer="", refusal="robot: its server has gone"),
        THERE,
        "answer",
        "has gone",
        "robot",
    ),
}


@pytest.mark.parametrize(("here", "there", "stage", "text", "remedy"), FAILURES.values(), ids=FAILURES)
def test_the_first_stage_that_fails(
    here: ServiceHere, there: ServiceAtServer | None, stage: str, text: str, remedy: str
) -> None:
    found = walk(here, there)
    assert not found.flows
    assert found.failed is not None
    assert found.failed is found.stages[-1]
    assert found.failed.name == stage
    assert text in found.failed.text
    assert remedy in found.failed.remedy


def test_every_stage_behind_the_link_can_fail_but_transport_and_calls() -> None:
    assert {stage for _, _, stage, _, _ in FAILURES.values()} == set(ORDER) - {"peer", "link", "transport", "calls"}


def test_without_a_link_nothing_else_is_judged() -> None:
    begin = (BEGIN[0], Check("link", CheckLevel.FAIL, "no link", "plug it in"))
    assert walk(begin=begin).stages == begin


def test_failed_calls_and_mismatches_are_warnings() -> None:
    for here, text in (
        (told(failed=1, problem="took more than 60 s"), "took more than 60 s"),
        (replace(told(problem="/client wants 456"), mismatched=True), "/client wants 456"),
    ):
        found = walk(here)
        assert found.flows
        assert found.stages[-1].level is CheckLevel.WARN
        assert text in found.stages[-1].text


def test_the_server_stage_is_unknown_without_an_answer() -> None:
    found = walk(there=None)
    assert found.flows
    assert found.stages[2].level is CheckLevel.UNKNOWN
