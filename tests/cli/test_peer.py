"""How a verb finds an agent and ends; what a list of very many things shows."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from typing import Annotated

import msgspec
import pytest

from rmpa.cli import peer
from rmpa.cli.options import Selection
from rmpa.core.errors import RmpaError
from rmpa.observe.snapshot import ModuleFacts, read_facts, reading
from tests.cli.conftest import Place
from tests.cli.test_pictures import refuse
from tests.observe.samples import SNAPSHOT

Agent = Callable[..., None]


def _serial() -> str:
    return "SN-4711"


class WithSerial(ModuleFacts, kw_only=True, frozen=True):
    serial: Annotated[str, reading(_serial)] = ""


def test_ctrl_c_shows_the_summary(place: Place, agent: Agent) -> None:
    agent()
    with place.start("peer", "ping", "joystick", "-i", "0.01") as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
    assert ("rtt min/avg/max/sd" in out, process.returncode, err) == (True, 0, "")


def test_a_new_fact_of_a_module_is_one_declaration_and_one_column(
    place: Place, agent: Agent, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent(agent=lambda _: WithSerial(**read_facts(WithSerial)))
    assert "SN-4711" not in place.run("peer", "info", "joystick")[1], "as this release, which does not know it"
    monkeypatch.setattr(peer, "ModuleFacts", WithSerial)
    monkeypatch.setattr(peer, "MODULE_FACTS", (("Serial", lambda module: module.serial),))
    assert "\nSerial:       SN-4711\n" in place.run("peer", "info", "joystick")[1]
    (shown,) = place.json("peer", "info", "joystick", "--json")
    assert (shown["name"], shown["module"]["serial"]) == ("joystick", "SN-4711")


def test_a_peer_that_does_not_tell_of_itself_is_shown_all_the_same(place: Place, agent: Agent) -> None:
    agent(agent=refuse(RmpaError("it does not know the question")))
    code, out, _ = place.run("peer", "info", "joystick")
    assert (code, "Its agent:    it does not know the question" in out) == (0, True)
    assert "Version:" not in out


def test_without_an_agent_or_with_two(place: Place, agent: Agent) -> None:
    expected = f"rmpa: no agent answers at {place.path}; start one with `rmpa up` [no-agent]\n"
    for words in (("list",), ("info", "x"), ("ping", "x")):
        assert place.run("peer", *words) == (1, "", expected)
    agent("base")
    agent("second", snapshot=msgspec.structs.replace(SNAPSHOT, peers=()))
    code, _, err = place.run("peer", "list", "--json")
    assert code == 1
    assert "several agents run on this machine: base, second; name one with --agent NAME or RMPA_AGENT" in err
    assert place.run("peer", "list", "--json", "--agent", "second") == (0, "[]\n", "")


def test_a_closed_pipe_is_quiet(place: Place, agent: Agent) -> None:
    agent()
    with place.start("peer", "ping", "joystick", "-i", "0.01", "--json") as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert json.loads(process.stdout.readline())["seq"] == 1
        process.stdout.close()
        process.wait(30)
        assert (process.returncode, process.stderr.read()) == (141, "")


def test_names_and_modules_are_selected_by_patterns() -> None:
    of = {"/a/scan": ["arm1"], "/b/scan": ["arm2"], "/cmd": []}
    chosen = Selection(match="*/scan", peer="*2")
    assert [name for name, peers in of.items() if chosen.wants(name, peers)] == ["/b/scan"]
    assert all(Selection().wants(name, peers) for name, peers in of.items())
    assert not Selection(peer="arm*").wants("/cmd", (None,))


def test_a_terminal_shows_the_first_of_many_unless_all_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not Selection().is_long(range(20_000))
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    assert Selection().is_long(range(20_000))
    assert not Selection().is_long(range(100))
    assert not Selection(everything=True).is_long(range(20_000))
