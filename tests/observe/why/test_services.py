"""``rmpa why`` of a service: each stage by itself."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import pytest

from rmpa.observe.check import Check, CheckLevel
from rmpa.observe.why.diagnosis import Diagnosis
from rmpa.observe.why.services import FarService, NearService, walk_service

BEGIN = (Check("peer", CheckLevel.OK, "known"), Check("link", CheckLevel.OK, "linked"))
FAR = FarService(node="/arm", service="/move", rule="services.allow has '/**'")
NEAR = NearService(wire="/move", offered=True, node="/arm", registered=True, answer="a/Move, md5 123", calls=3)
ORDER = ("peer", "link", "server", "policy there", "offer", "shown", "graph", "answer", "calls")


def walk(near: NearService = NEAR, far: FarService | None = FAR, begin: tuple[Check, ...] = BEGIN) -> Diagnosis:
    return walk_service(begin, "base", "robot", "/move", near, far, "" if far else "it is older")


def test_what_can_be_called() -> None:
    found = walk()
    assert found.flows
    assert (found.kind, found.name, found.peer, found.to, found.node) == ("service", "/move", "robot", "base", "/arm")
    assert tuple(stage.name for stage in found.stages) == ORDER
    assert found.stages[-1].text == "3 from here, 0 of them failed"
    assert msgspec.convert(msgspec.to_builtins(found), Diagnosis) == found


FAILURES: dict[str, tuple[NearService, FarService | None, str, str, str]] = {
    "nobody provides it": (NEAR, FarService(), "server", "no node of robot provides /move", "start its server"),
    "nearly its name": (NEAR, FarService(near="/mov"), "server", "no node", "did you mean /mov?"),
    "its server is stuck": (
        NEAR,
        msgspec.structs.replace(FAR, refusal="no answer within 2 s"),
        "server",
        "/arm on robot is registered for it, and does not answer: no answer within 2 s",
        "rosnode ping /arm",
    ),
    "an older agent": (NearService(), None, "server", "it is older", "rosservice info /move"),
    "policy there": (
        NEAR,
        msgspec.structs.replace(FAR, crosses=False, rule="services.deny has '/move'"),
        "policy there",
        "services.deny has '/move'",
        "rmpa.toml of robot",
    ),
    "not offered yet": (NearService(wire="/move"), FAR, "offer", "has not come here", "both logs"),
    "policy here": (
        replace(NEAR, hidden="policy: services.deny has '/move'"),
        FAR,
        "shown",
        "services.deny has '/move'",
        "rmpa reload",
    ),
    "another provider": (
        replace(NEAR, hidden="/local of this module provides it itself"),
        FAR,
        "shown",
        "/local of this module",
        "another name",
    ),
    "not registered": (replace(NEAR, registered=False), FAR, "graph", "does not have it", "5 s"),
    "no answer": (replace(NEAR, answer="", refusal="robot: its server has gone"), FAR, "answer", "has gone", "robot"),
}


@pytest.mark.parametrize(("near", "far", "stage", "text", "remedy"), FAILURES.values(), ids=FAILURES)
def test_the_first_stage_that_fails(
    near: NearService, far: FarService | None, stage: str, text: str, remedy: str
) -> None:
    found = walk(near, far)
    assert not found.flows
    assert found.failed is not None
    assert found.failed is found.stages[-1]
    assert found.failed.name == stage
    assert text in found.failed.text
    assert remedy in found.failed.remedy


def test_every_stage_behind_the_link_can_fail_but_the_calls() -> None:
    assert {stage for _, _, stage, _, _ in FAILURES.values()} == set(ORDER) - {"peer", "link", "calls"}


def test_nothing_is_looked_at_behind_a_link_that_is_not_there() -> None:
    begin = (BEGIN[0], Check("link", CheckLevel.FAIL, "no link", "plug it in"))
    assert walk(begin=begin).stages == begin


def test_failed_calls_and_mismatches_are_warned_of() -> None:
    for near, text in (
        (replace(NEAR, failed=1, problem="took more than 60 s"), "took more than 60 s"),
        (replace(NEAR, mismatch="/client wants 456"), "/client wants 456"),
    ):
        found = walk(near)
        assert found.flows
        assert found.stages[-1].level is CheckLevel.WARN
        assert text in found.stages[-1].text


def test_an_agent_that_does_not_tell_leaves_its_stage_open() -> None:
    found = walk(far=None)
    assert found.flows
    assert found.stages[2].level is CheckLevel.UNKNOWN
