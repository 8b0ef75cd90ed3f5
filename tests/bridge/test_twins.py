"""Which peers are modules of the same kind as this one, by the names of both."""

from __future__ import annotations

from itertools import permutations
from typing import Final

import pytest

from rmpa.bridge.twins import telling, twin_names, twin_text

Module = tuple[set[str], set[str]]
"""What its nodes publish, and what they subscribe to."""

ROBOT: Final[Module] = ({"/odom", "/scan", "/tf", "/diagnostics"}, {"/cmd_vel", "/tf"})
RESOURCE: Final = {
    f"/{{}}/{name}"
    for name in ("quality", "responses", "alarms", "profile", "context", "state", "decision", "descriptor")
}
DEMO: Final[dict[str, Module]] = {
    "joystick": ({"/command_information"}, set()),
    "velocity": ({"/velocity_order"}, {"/command_information"}),
    "base": ({"/odom"}, {"/velocity_order"}),
    "pc": (set(), {"/command_information", "/velocity_order", "/odom"}),
}
"""The four modules of the demo, whose resources report by names of one form."""
ORDINARY: Final[dict[str, tuple[Module, Module]]] = {
    "talker and listener": (({"/chatter"}, set()), (set(), {"/chatter"})),
    "two talkers": (({"/chatter"}, set()), ({"/chatter"}, set())),
    "base and joystick": (({"/odom"}, {"/cmd_vel"}), ({"/cmd_vel", "/joy"}, {"/joy"})),
    "a driver of many": (
        ({"/odom", "/battery"}, {"/left", "/right", "/lift", "/grip"}),
        ({"/left", "/right", "/lift", "/grip"}, {"/odom", "/battery"}),
    ),
    "what all modules have": (
        ({"/tf", "/diagnostics", "/cam/parameter_updates", "/rosout"}, {"/tf", "/cmd"}),
        ({"/tf", "/diagnostics", "/cam/parameter_updates", "/rosout"}, {"/tf", "/cmd"}),
    ),
    "the same tools": (({"/client_count", "/connected_clients"}, {"/x"}), ({"/client_count"}, {"/x", "/y"})),
}


def judged(ours: Module, theirs: Module, *, told: bool = True) -> tuple[str, ...]:
    own, peer = (tuple(map(telling, module)) for module in (ours, theirs))
    return twin_names(own[0], own[1], peer[0], peer[1] if told else frozenset())


def test_two_robots_of_one_kind_are_twins_before_either_is_driven() -> None:
    assert judged(ROBOT, ROBOT) == ("/cmd_vel", "/odom", "/scan")
    assert not judged(ROBOT, ROBOT, told=False), "it has not said what its nodes take"


def test_a_robot_that_is_driven_over_there_is_told_before_the_peer_says_what_it_takes() -> None:
    driven = (ROBOT[0] | {"/cmd_vel"}, ROBOT[1])
    assert judged(ROBOT, driven, told=False) == ("/cmd_vel", "/odom", "/scan")


@pytest.mark.parametrize("pair", ORDINARY.values(), ids=ORDINARY)
def test_ordinary_pairs_are_none(pair: tuple[Module, Module]) -> None:
    assert not judged(*pair)
    assert not judged(*reversed(pair))


def test_the_modules_of_the_demo_are_none() -> None:
    for (name, ours), (other, theirs) in permutations(DEMO.items(), 2):
        both = [
            (out | {each.format(which) for each in RESOURCE}, into | {f"/{which}/requirements"})
            for which, (out, into) in ((name, ours), (other, theirs))
        ]
        assert not judged(*both), (name, other)


def test_the_text_says_what_parts_them() -> None:
    text = twin_text("r2", ("/cmd_vel", "/a", "/b", "/c", "/d"))
    problem, _, remedy = text.partition("; ")
    assert "(/cmd_vel, /a, /b, /c and 1 more)" in problem
    assert "rmpa up --prefix-peers" in remedy
    assert 'name = "r2" and prefix = "/{peer}"' in remedy
