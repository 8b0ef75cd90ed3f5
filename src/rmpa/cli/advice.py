"""What ``rmpa up`` says on a terminal about the next step; a log never has it."""

from __future__ import annotations

import contextlib
import os
import time
from typing import TYPE_CHECKING, Final

import click

from rmpa.cli.output import printable
from rmpa.core.errors import RmpaError
from rmpa.observe.control_client import ControlClient, runtime_dir, same_core
from rmpa.ros.environment import DEFAULT_MASTER_URI, shown_uri

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.config.settings import Settings
    from rmpa.observe.snapshot import Snapshot

# Seconds in which a first peer is linked, if there is one: it takes some 0.3 s.
_FIRST_PEER: Final = 2.0
# Seconds between two looks.
_LOOK: Final = 0.2
_COLUMNS: Final = 80
_HEADS: Final = ("Next:", "     ", "     ")


def advises(settings: Settings, environ: Mapping[str, str], *, quiet: bool) -> bool:
    """Whether the terminal of an agent gets advice: not if a service manager or a program reads what it says."""
    return not (quiet or settings.log_json or "NOTIFY_SOCKET" in environ)


def advise(settings: Settings) -> None:
    """Print the next steps on standard error, as soon as a peer is linked or has had the time for it."""
    place = runtime_dir(os.environ, settings.runtime_dir) / f"{settings.name}.sock"
    until = time.monotonic() + _FIRST_PEER
    with contextlib.suppress(RmpaError, OSError), ControlClient(place) as client:
        shown = client.snapshot(topics=(), services=())
        while not any(peer.link for peer in shown.peers) and time.monotonic() < until:
            time.sleep(_LOOK)
            shown = client.snapshot(topics=(), services=())
        lines = next_steps(settings, shown, os.environ.get("ROS_MASTER_URI", ""))
        text = [printable(f"{head} {line}") for head, line in zip(_HEADS, lines, strict=True)]
        click.echo("\n".join(text), err=True)


def next_steps(settings: Settings, shown: Snapshot, master: str) -> list[str]:
    """What to do after the start of an agent, in three lines.

    Args:
        settings: Its settings.
        shown: What it knows.
        master: The ROS_MASTER_URI of its shell; empty: not set.
    """
    core = shown_uri(shown.agent.core_uri)
    nodes = "nodes of this machine join as soon as they start"
    if not same_core(core, master or DEFAULT_MASTER_URI):
        wrong = "ROS_MASTER_URI is wrong" if master else "each shell of nodes needs"
        nodes = _fitting(f"{wrong}: export ROS_MASTER_URI={core}", f"export ROS_MASTER_URI={core}")
        if same_core(core, DEFAULT_MASTER_URI):
            # Not unset: nodes of roscpp end without it.
            nodes = _fitting(f"wrong: export ROS_MASTER_URI={core}, also in ~/.bashrc", nodes)
    page = f"http://localhost:{settings.web.port}/" if settings.web.enabled else "rmpa web"
    return [_about_peers(settings, shown), f"to look: rmpa peer list; in a browser: {page}", nodes]


def _fitting(*lines: str) -> str:
    """The first of several ways to say something that fits a terminal, else the last: no command is cut."""
    most = _COLUMNS - len(_HEADS[0]) - 1
    return next((line for line in lines if len(line) <= most), lines[-1])


def _about_peers(settings: Settings, shown: Snapshot) -> str:
    linked = [peer.name for peer in shown.peers if peer.link]
    if linked:
        others = f" and {len(linked) - 1} more" if len(linked) > 1 else ""
        hint = "if a topic does not arrive: rmpa why NAME"
        return _fitting(f"linked with {linked[0]}{others}; {hint}", f"linked with {len(linked)}; {hint}")
    if shown.peers:
        hint = f"rmpa why --module {shown.peers[0].name}"
        return _fitting(f"{shown.peers[0].name} was found but is not linked: {hint}", f"no link: {hint}", hint)
    if shown.strangers:
        one = shown.strangers[0]
        hint = f"{'pending' if one.invite else 'not of this mesh'}: rmpa peer list says what to do"
        return _fitting(f"{one.name} is {hint}", f"a module is {hint}")
    if "lo" in settings.interfaces:
        return f"no peer yet; a second module here: rmpa up --name OTHER --core-port {settings.core_port + 1}"
    if shown.agent.addresses in ((), ("127.0.0.1",)):
        return "no network: connect this machine to one, or see rmpa doctor"
    domain = f" --domain {settings.domain}" if settings.domain else ""
    if shown.trust is not None:
        return "no peer yet: rmpa trust invite here, rmpa trust join and rmpa up there"
    if not settings.multicast.enabled:
        there = f"rmpa up --name OTHER{domain} --seed {shown.agent.guid.partition('#')[0]}"
        return _fitting(f"no peer yet; there: {there}", f"there: {there}")
    return f"no peer yet; on the other machine: rmpa up --name OTHER{domain}"
