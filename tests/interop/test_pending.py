"""A module without keys knocks at a secured mesh: it is pending at both ends until an invitation lets it in."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest

pytest.importorskip("cryptography")

from lab.bed.agents import RMPA
from lab.bed.chromium import Chromium
from lab.bed.processes import Process, eventually
from tests.interop.secured import SecuredMesh, control
from tests.interop.web import needs_browser

if TYPE_CHECKING:
    from pathlib import Path

    from lab.bed.agents import Agent
    from lab.bed.namespaces import Lab
    from rmpa.observe.snapshot import PeerInfo
    from tests.interop.conftest import AgentFactory

pytestmark = [pytest.mark.netns, pytest.mark.timeout(150)]

INVITE = "rmpa trust invite --module arm"


class Gate:
    """A secured mesh of ``base``, its authority, and ``pc``; ``arm`` has no keys, and knocks."""

    def __init__(self, home: Path, lab: Lab, agent: AgentFactory) -> None:
        SecuredMesh(home, "base").add("pc")
        hosts = lab.hosts("base", "pc", "arm")
        self.base, self.pc, self.arm = (agent(host, name=host.name, log_level="info") for host in hosts)
        self.base.wait_peer("pc")

    def join(self, line: str) -> None:
        """Run the line of an invitation at ``arm``, and start its agent again, as the line's output says."""
        code, out = self.arm.rmpa(*line.split()[1:])
        assert code == 0, out
        self.arm.kill()  # without a goodbye, so that the others have heard of it before as of a module without keys
        self.arm.restart()
        for member in (self.base, self.pc):
            member.wait_peer("arm")

    def stranger(self, member: Agent, name: str) -> PeerInfo:
        """What a module shows of one that is not of its mesh, as soon as it does."""
        found: list[PeerInfo] = eventually(
            lambda: [one for one in member.snapshot().strangers if one.name == name],
            what=f"{member.name} shows {name}",
        )
        return found[0]


@pytest.fixture
def gate(tmp_path: Path, lab: Lab, agent: AgentFactory) -> Gate:
    return Gate(tmp_path, lab, agent)


def told(agent: Agent, name: str) -> tuple[str, str]:
    """The state of a module in `rmpa peer list`, and the line below the table."""
    _, out = agent.rmpa("peer", "list")
    row = re.search(rf"^{name} +(\w+)", out, re.MULTILINE)
    line = re.search(rf"^! (?:\w+, )*{name}(?:, \w+)*: (.+)", out, re.MULTILINE)
    return row[1] if row else "", line[1] if line else ""


def test_a_newcomer_is_pending_at_both_ends_until_the_line_lets_it_in(gate: Gate) -> None:
    for there, name, rest in (
        (gate.base, "arm", f"if it is yours, run here: {INVITE} (it prints the line to run on arm)"),
        (gate.pc, "arm", f"if it is yours, run on base: {INVITE} (it prints the line to run on arm)"),
        (gate.arm, "base", f"to join it, run on its authority: {INVITE} (it prints the line to run here)"),
    ):
        gate.stranger(there, name)
        eventually(lambda there=there, name=name: told(there, name)[0] == "pending", what=f"pending at {there.name}")  # type: ignore[misc]
        assert rest in told(there, name)[1]
        assert f"{name} is pending" in there.rmpa("why", "--module", name)[1]
        code, info = there.rmpa("peer", "info", name)
        assert (code, re.findall(r"Invitation: +(.+)", info)) == (0, [INVITE])
    code, printed = gate.base.rmpa(*INVITE.split()[1:], "--no-wait")
    assert code == 0
    gate.join(f"rmpa trust join {printed.split()[-1]}")
    assert not any(each.snapshot().strangers for each in (gate.base, gate.pc, gate.arm))


def test_one_that_was_revoked_says_so_and_is_not_pending(gate: Gate) -> None:
    gate.join(f"rmpa trust join {control(gate.base, 'invite', name='arm')['token']}")
    control(gate.base, "revoke", name="arm")
    shown = [*(gate.stranger(each, "arm") for each in (gate.base, gate.pc))]  # also once the roster has forgotten it
    assert {(one.state, one.invite) for one in shown} == {("revoked", "")}
    assert told(gate.arm, "base")[0] == "revoked"


def test_a_module_that_takes_the_name_of_a_member_is_not_pending(gate: Gate, agent: AgentFactory, lab: Lab) -> None:
    eve = agent(lab.host("eve", 0), name="pc")
    one = gate.stranger(gate.base, eve.snapshot().agent.guid.partition("#")[0])
    assert (one.state, one.invite) == ("foreign", "")
    assert "do not invite it" in one.last_error
    assert "linked" in gate.base.rmpa("peer", "info", "pc")[1]


@needs_browser
async def test_the_page_of_the_authority_invites_and_shows_the_new_module_by_itself(gate: Gate) -> None:
    gate.stranger(gate.base, "arm")
    env = {**gate.base.env, "RMPA_LOG_LEVEL": "debug"}
    with Process(gate.base.host.command([RMPA, "web", "--control"]), env=env, name="rmpa web") as served:
        url = served.wait_for(r"(https://127.0.0.1:\d+/\?token=\S+)")[1]
        async with Chromium(gate.base.host) as page:
            await page.send("Security.setIgnoreCertificateErrors", ignore=True)  # it does not know the mesh's CA
            await page.goto(url)
            await page.wait_text(INVITE)
            await page.run("window.same = true")
            await page.click("Invite arm")
            await page.wait("document.querySelector('.token')")
            line = str(await page.run("document.querySelector('.token').textContent"))
            secret = line.rsplit(maxsplit=1)[-1]
            assert secret not in await page.run("JSON.stringify(window.rmpa.state) + location.href")
            _, status = gate.base.rmpa("trust", "status", "--json")
            assert secret not in status + served.output + gate.base.process.output
            gate.join(line)
            await page.wait("document.querySelector('[data-module=arm].up') && !document.querySelector('.outside')")
            assert await page.run("window.same")
        assert secret not in served.output + gate.base.process.output
