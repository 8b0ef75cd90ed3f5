"""Reading the settings again: what changes, what waits, and what SIGHUP means."""

from __future__ import annotations

import asyncio
import os
import pty
import signal
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pytest

from rmpa.agent import process as reload
from rmpa.agent.process import Reloader
from rmpa.config.peer_rules import ModuleGroup, PeerRule, PermissionRule, PolicySettings
from rmpa.config.read import Loaded
from rmpa.config.settings import Settings, TrustSettings
from rmpa.config.values import HostPort
from rmpa.core.contract import ContractRule
from rmpa.core.errors import ConfigError
from tests.agent.test_agent import running

if TYPE_CHECKING:
    from collections.abc import Callable

# A port that another program has.
TAKEN: Final = -1
OLD = Settings(name="a", config_file=Path("/etc/rmpa.toml"))
NEW = replace(
    OLD,
    policy=PolicySettings(deny=("/secret",)),
    peers=(PeerRule("b", "/b"),),
    contracts=(ContractRule(("/a",), (), {"depth": 3}),),
    log_level="debug",
    port=40001,
    seeds=(HostPort("10.0.0.1", 7),),
    core_port=11312,
)


async def could_start(_running: Settings, _new: Settings) -> None:
    """Any settings."""


def reloader(load: Callable[[], Loaded], applied: list[Settings]) -> Reloader:
    return Reloader(OLD, load, applied.append, could_start)


async def test_what_can_be_taken_is_taken_and_the_rest_is_named() -> None:
    applied: list[Settings] = []
    made = reloader(lambda: Loaded(NEW, ("doubtful",)), applied)
    checked = await made.reload(check=True)
    assert (applied, made.waiting) == ([], ())
    reply = await made.reload()
    assert reply == checked
    assert reply.file == "/etc/rmpa.toml"
    assert reply.changed == ("bridge.deny", "[[peer]]", "[[contract]]", "log.level")
    waiting = (
        "core.port (11312 instead of 11311)",
        "mesh.port (40001 instead of 0)",
        "discovery.seeds ([10.0.0.1:7] instead of [])",
    )
    assert reply.restart == made.waiting == waiting
    assert reply.notes == ("doubtful",)
    assert applied == [replace(NEW, port=0, seeds=(), core_port=11311)]
    again = await made.reload()
    assert (again.changed, len(again.restart), len(applied)) == ((), 3, 1), "only what waits is left"


async def test_permissions_are_taken_and_what_waits_beside_them_goes_on_waiting() -> None:
    rule = PermissionRule(("arm",), names={"publish": ("/x",)})
    trust = TrustSettings(groups=(ModuleGroup("arms", ("arm*",)),), rules=(rule,), require=True)
    applied: list[Settings] = []
    made = reloader(lambda: Loaded(replace(OLD, trust=trust)), applied)
    reply = await made.reload()
    assert (reply.changed, reply.restart) == (("trust.groups", "[[permission]]"), made.waiting)
    assert applied == [replace(OLD, trust=replace(trust, require=False))]
    assert (await made.reload()).changed == ()
    assert made.waiting == ("trust.require (true instead of false)",)


async def test_invalid_settings_change_nothing(caplog: pytest.LogCaptureFixture) -> None:
    def load() -> Loaded:
        raise ConfigError("bridge.deny", "no", "yes", Path("/x.toml"), 7)

    applied: list[Settings] = []
    made = reloader(load, applied)
    assert (await made.reload(check=True)).problem == "/x.toml:7: bridge.deny: no; yes"
    assert not caplog.records
    assert (await made.reload()).problem == "/x.toml:7: bridge.deny: no; yes"
    assert applied == []
    assert "the settings stay as they are: /x.toml:7: bridge.deny: no; yes" in caplog.text


async def test_an_agent_that_a_program_made_says_so() -> None:
    with pytest.raises(ConfigError, match="this agent was given them by a program"):
        await Reloader(OLD, None, lambda _: None, could_start).reload()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"core_host": "198.51.100.7"}, "this machine does not have that address"),
        ({"core_port": TAKEN}, "is already in use"),
        ({"port": TAKEN}, "is in use, perhaps by another agent"),
        ({"trust": TrustSettings(require=True)}, "has joined no secured mesh"),
    ],
)
async def test_what_would_not_start_is_refused_at_once(
    settings: Callable[..., Settings], wrong: dict[str, Any], said: str
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        changed = {key: port if value == TAKEN else value for key, value in wrong.items()}
        async with running(settings("a")) as (agent,):
            denied = replace(settings("a").policy, deny=("/secret",))
            agent.reloader._load = lambda: Loaded(replace(settings("a"), policy=denied, **changed))
            reply = await agent.reloader.reload()
            assert said in reply.problem
            assert agent.settings.policy.deny == (), "none of it holds"


async def test_a_port_that_the_agent_has_itself_may_be_written_down(settings: Callable[..., Settings]) -> None:
    async with running(settings("a")) as (agent,):
        assert agent.network.endpoint is not None
        core_port = int(agent.core.uri.rstrip("/").rpartition(":")[2])
        fixed = replace(settings("a"), port=agent.network.endpoint.port, core_port=core_port)
        agent.reloader._load = lambda: Loaded(fixed)
        assert (await agent.reloader.reload()).problem == ""


async def nothing() -> None:
    """Start, close or watch nothing."""


# --- SIGHUP -------------------------------------------------------------------------------------------------------


async def test_sighup_reloads_and_notifies_the_service_manager(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr(reload, "notify_service_manager", told.append)
    monkeypatch.setattr(reload, "has_terminal", lambda: False)
    applied: list[Settings] = []

    async def start() -> None:
        os.kill(os.getpid(), signal.SIGHUP)  # also one that comes during the start

    async def watch() -> None:
        while told.count("READY=1") < 2:
            await asyncio.sleep(0.005)

    await reload.serve(start, nothing, reloader(lambda: Loaded(NEW), applied), watch)
    assert applied
    assert told[0] == "READY=1"
    assert told[1].startswith("RELOADING=1\nMONOTONIC_USEC=")


async def test_an_ignored_sighup_stays_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        await reload.serve(nothing, nothing, reloader(lambda: pytest.fail("no reload was asked for"), []), nothing)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


_ON_A_TERMINAL = """
import fcntl, os, sys, termios
os.setsid()
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
os.execv(sys.executable, [sys.executable, "-m", "rmpa.cli.main", "up", *sys.argv[1:]])
"""


@pytest.mark.pty
def test_an_agent_whose_terminal_is_closed_ends(tmp_path: Path, unused_tcp_port: int) -> None:
    ours, its = pty.openpty()
    words = ["--name", "a", "--interface", "lo", "--multicast", "off", "--core-port", str(unused_tcp_port)]
    with subprocess.Popen(
        [sys.executable, "-c", _ON_A_TERMINAL, *words],
        stdin=its,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env={**os.environ, "RMPA_RUNTIME_DIR": str(tmp_path)},
        text=True,
    ) as process:
        os.close(its)
        assert process.stderr is not None
        seen = ""
        try:
            while "ROS_MASTER_URI" not in seen and (line := process.stderr.readline()):
                seen += line
            process.send_signal(signal.SIGHUP)  # the terminal is there: it reads its settings
            while "settings read again" not in seen and (line := process.stderr.readline()):
                seen += line
            os.close(ours)
            rest = process.stderr.read()
            assert process.wait(20) == 0
        finally:
            process.kill()  # else the end of the block would wait for it
    assert "settings read again: nothing has changed" in seen
    assert "the terminal is gone" in rest
