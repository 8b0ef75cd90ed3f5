"""What a page gets of Smart Resources, by the topics to which its client may subscribe."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import pytest

from rmpa.web.hub.rights import FULL
from rmpa.web.monitor.resources import ResourceFacts, resource_detail, resource_entry
from rmpa.web.monitor.visible import visible_history
from tests.web.monitor.test_session import Page, denying

if TYPE_CHECKING:
    from rmpa.web.hub.rights import Rights


def facts(name: str) -> ResourceFacts:
    return ResourceFacts(
        name=name,
        peer="lab",
        state="active",
        profile="fine",
        context="night",
        health={"level": "WARN", "message": "rate 9 Hz", "values": {"rate": "9 Hz"}},
        parameters={"secret": 7},
        clients=({"name": "planner"},),
        descriptor={"role": "acting", "description": "picks things up"},
        decision={"chosen": "fine"},
    )


ARM, BASE = facts("/arm"), facts("/base")
HISTORY = [
    {"text": "rate is low", "resource": "lab:/arm"},
    {"text": "the battery is low", "resource": "/base"},
    {"text": "lab: is away", "module": "lab"},
]


def shown_to(rights: Rights) -> dict[str, Any]:
    """The state that a page gets which looks at both resources."""
    page = Page(rights)
    page.details = {("resource", one.key): resource_detail(one, "base") for one in (ARM, BASE)}
    page.send("look", at=[["resource", ARM.key], ["resource", BASE.key]])
    page.update(
        resources={one.key: resource_entry(one, "base") for one in (ARM, BASE)},
        alarms={one.key: {"resource": one.key, "text": "rate 9 Hz"} for one in (ARM, BASE)},
        topics={"/arm/state": {}},
    )
    state: dict[str, Any] = page.state
    return state


def viewer(glob: str) -> Rights:
    return dataclasses.replace(FULL, look=denying(subscribe=glob))


def test_a_page_gets_nothing_of_a_resource_whose_topics_are_denied() -> None:
    state = shown_to(viewer("/arm/**"))
    assert set(state["resources"]) == set(state["alarms"]) == {"lab:/base"}
    assert set(state["detail"]) == {"resource:lab:/base"}
    assert state["detail"]["resource:lab:/base"] == resource_detail(BASE, "base")
    assert "/arm/state" in state["topics"]  # names of the graph are shown to every client
    assert [each["text"] for each in visible_history(HISTORY, viewer("/arm/**"))] == [
        "the battery is low",
        "lab: is away",
    ]


@pytest.mark.parametrize(
    ("topic", "entry", "detail"),
    [
        ("state", {"state": ""}, {"state": ""}),
        ("profile", {"profile": ""}, {"profile": ""}),
        ("context", {"context": ""}, {"context": ""}),
        ("quality", {"level": "", "message": ""}, {"health": None}),
        ("responses", {"clients": 0}, {"clients": []}),
        ("decision", {}, {"decision": {}}),
        ("parameter_updates", {}, {"parameters": {}}),
    ],
)
def test_a_page_gets_no_value_of_a_topic_that_is_denied(
    topic: str, entry: dict[str, Any], detail: dict[str, Any]
) -> None:
    state = shown_to(viewer(f"/arm/{topic}"))
    assert state["resources"][ARM.key] == resource_entry(ARM, "base") | entry
    expected = {key: value for key, value in (resource_detail(ARM, "base") | detail).items() if value is not None}
    assert state["detail"][f"resource:{ARM.key}"] == expected
    assert (ARM.key in state["alarms"]) == (topic != "quality")


def test_alarms_of_the_past_need_the_right_to_the_topic_of_alarms() -> None:
    assert [each["text"] for each in visible_history(HISTORY, viewer("/base/alarms"))] == [
        "rate is low",
        "lab: is away",
    ]
    assert visible_history(HISTORY, FULL) == HISTORY


def test_without_rules_a_page_gets_all() -> None:
    state = shown_to(FULL)
    assert state["resources"] == {one.key: resource_entry(one, "base") for one in (ARM, BASE)}
    assert set(state["alarms"]) == {ARM.key, BASE.key}
