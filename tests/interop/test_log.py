"""One log of all modules: of rospy and roscpp nodes, levels that are set across, and /rosout where it crosses."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest

from lab.bed.agents import RMPA, Agent
from lab.bed.processes import Process, eventually
from tests.interop.conftest import ModuleFactory
from tests.interop.modules import Module

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(180)]


def lines(agent: Agent, *options: str) -> list[dict[str, Any]]:
    """What ``rmpa log`` shows, of nodes alone."""
    _, output = agent.rmpa("log", "--json", *options)
    found = [json.loads(line) for line in output.splitlines() if line.startswith("{")]
    return [line for line in found if not line["agent"]]


def clerk(module: Module, name: str) -> Process:
    """A rospy node that logs what it is told."""
    started = module.ros.rospy("text_teller", commands=True, name=name)
    started.wait_event("up")
    return started


def say(node: Process, text: str) -> None:
    """Let a clerk log a text, as a warning."""
    node.tell(json.dumps({"log": text}))


def heard(agent: Agent, text: str, *options: str) -> dict[str, Any]:
    """The line of a text, once it is there."""

    def find() -> list[dict[str, Any]]:
        return [line for line in lines(agent, *options) if line["text"] == text]

    return eventually(find, what=f"{text!r} in the log at {agent.name}")[0]


def test_the_lines_of_two_modules_are_one_log_in_their_order(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    here, there = clerk(a, "here"), clerk(b, "there")
    texts = [f"line {number}" for number in range(6)]
    for number, text in enumerate(texts):
        say(there if number % 2 else here, text)
        line = heard(a.agent, text)
        assert (line["module"], line["node"]) == (("b", "/there") if number % 2 else ("a", "/here"))
        assert line["level"] == "warn"
    for agent in (a.agent, b.agent):
        assert [line["text"] for line in lines(agent, "--level", "warn") if line["text"] in texts] == texts
    assert {line["node"] for line in lines(a.agent, "b")} == {"/there"}
    assert [line["text"] for line in lines(a.agent, "--node", "/there", "-n", "1")] == texts[-1:]

    command = a.host.command([RMPA, "log", "-f", "--level", "warn"])
    with Process(command, env={**a.agent.env, "RMPA_AGENT": "a"}, name="rmpa log") as follows:
        follows.wait_for("line 5")
        say(there, "while it is followed")
        follows.wait_for("b:/there: while it is followed")
        say(there, "bell \a, \x1b]0;title\x07 and\nmore")
        follows.wait_for(re.escape(r"bell \x07, \x1b]0;title\x07 and\nmore"))
        assert not set(follows.output) & {"\a", "\x1b"}


@pytest.mark.trap(43)
def test_the_level_of_a_rospy_and_of_a_roscpp_node_is_set_from_another_module(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    told = clerk(b, "clerk")
    b.ros.roscpp("talker", "__name:=speaker", rate=10)
    b.wait_topic("/chatter")

    code, output = a.agent.rmpa("node", "log-level", "b:/clerk", "--json")
    assert (code, json.loads(output)["loggers"]["rosout"]) == (0, "info")
    assert a.agent.rmpa("node", "log-level", "b:/clerk", "error")[0] == 0
    say(told, "hidden")
    assert a.agent.rmpa("node", "log-level", "b:/clerk", "rosout", "warn")[0] == 0
    say(told, "seen")
    heard(a.agent, "seen")
    assert "hidden" not in [line["text"] for line in lines(a.agent)]

    debug = ("b", "--node", "/speaker", "--level", "debug")
    assert not [line for line in lines(a.agent, *debug) if line["level"] == "debug"]
    assert a.agent.rmpa("node", "log-level", "b:/speaker", "ros.roscpp", "debug")[0] == 0
    b.ros.roscpp("listener")  # whose connection roscpp reports
    eventually(
        lambda: [line for line in lines(a.agent, *debug) if line["level"] == "debug"], what="roscpp's own lines"
    )

    # Where Debian's roscpp would crash it is not asked; elsewhere it tells (trap 43).
    code, output = a.agent.rmpa("node", "log-level", "b:/speaker")
    assert ("crashes when it lists its loggers" in output) if code else ("ros.roscpp " in output)
    assert a.agent.rmpa("node", "log-level", "b:/speaker", "warn")[0] == 0
    assert a.agent.rmpa("node", "ping", "b:/speaker", "-c", "1")[0] == 0

    for wrong, text in (
        (("b:/clerk", "rosout", "loud"), "'loud' is not a level"),
        (("b:/nobody",), "b has no node /nobody"),
    ):
        code, output = a.agent.rmpa("node", "log-level", *wrong)
        assert code != 0
        assert text in output


def test_rosout_crosses_where_both_modules_say_so_with_its_origin_and_without_an_echo(modules: ModuleFactory) -> None:
    a, b = modules("a", "b", config="[bridge]\nrosout = true\n", fresh=True)
    here, there = clerk(a, "here"), clerk(b, "there")
    echoes = {each.name: each.ros.start("rostopic", "echo", "/rosout_agg", name="ears") for each in (a, b)}

    def crossed() -> bool:
        say(there, "knock")
        say(here, "knock")
        return 'name: "/rmpa/b/there"' in echoes["a"].output and 'name: "/rmpa/a/here"' in echoes["b"].output

    eventually(crossed, what="each log at the other")
    say(there, "once from b")
    say(here, "once from a")
    for module, node, text in ((a, "/rmpa/b/there", "from b"), (b, "/rmpa/a/here", "from a")):
        echoes[module.name].wait_for(f"once {text}")
        assert f'name: "{node}"' in echoes[module.name].output
    for agent in (a.agent, b.agent):
        heard(agent, "once from a")
        heard(agent, "once from b")
        found = [(line["module"], line["text"]) for line in lines(agent) if line["text"].startswith("once")]
        assert sorted(found) == [("a", "once from a"), ("b", "once from b")]  # kept by its own module alone
    for echo in echoes.values():
        assert [echo.output.count(f'msg: "once from {name}"') for name in ("a", "b")] == [1, 1]


def test_a_module_that_hangs_is_named_and_the_others_are_shown(modules: ModuleFactory) -> None:
    a, b = modules("a", "b", fresh=True)
    say(clerk(a, "here"), "of this one")
    heard(a.agent, "of this one")
    b.agent.freeze()
    code, output = a.agent.rmpa("log", "--level", "warn")
    assert code == 0
    assert "of this one" in output
    assert "! b: " in output
    assert a.agent.rmpa("log", "b")[0] == 1
    b.agent.thaw()
