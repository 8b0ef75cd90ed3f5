"""The module that ``rmpa trust`` is about: its settings, its files, and its agent if that runs."""

from __future__ import annotations

import os
import socket
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import click

from rmpa.cli.module import find_module
from rmpa.cli.output import warn
from rmpa.config.module_name import GATEWAY_SUFFIX, keep_name, kept_name, note_state_dir
from rmpa.config.read import load_settings
from rmpa.core.errors import ConfigError, RmpaError, StartError, UnreachableError
from rmpa.observe.control_client import ControlClient
from rmpa.trust.joining import TrustStatus
from rmpa.trust.store import TrustStore

if TYPE_CHECKING:
    from rmpa.config.module_name import ModuleName
    from rmpa.trust.authority import MeshAuthority
    from rmpa.trust.membership import Membership

_T = TypeVar("_T")
name_option = click.option(
    "--name",
    metavar="NAME",
    help="This module. [default: RMPA_AGENT, RMPA_NAME, rmpa.toml, the agent that runs; else as rmpa up has it]",
)
config_option = click.option(
    "--config", "file", metavar="FILE", help="Settings. [default: ./rmpa.toml, ~/.config/rmpa, /etc/rmpa]"
)


@dataclass(frozen=True, slots=True)
class TrustPlace:
    """One module.

    Args:
        chosen: Its name, and why it was chosen.
        store: Its files.
        state: The state directory that they are in.
        socket: The control socket of its agent; ``None``: none runs.
    """

    chosen: ModuleName
    store: TrustStore
    state: Path
    socket: Path | None

    @property
    def name(self) -> str:
        """Its name."""
        return self.chosen.name

    def call(self, what: str, reply: type[_T], **args: object) -> _T:
        """Let the agent do something.

        Raises:
            UnreachableError: No agent runs, or it does not answer.
            PeerRefused: It refuses, and says why.
        """
        if self.socket is None:
            raise UnreachableError(f"agent {self.name!r}", "this machine", "start it: rmpa up")
        with ControlClient(self.socket) as client:
            return client.call("trust", reply, what=what, **args)

    @property
    def agent(self) -> str:
        """How the agent runs: ``secured``, ``plain`` or ``off``."""
        return "off" if self.socket is None else self.call("status", TrustStatus).agent

    def membership(self) -> Membership:
        """What the files say, without the agent.

        Raises:
            StartError: Trust is off here, or the files are broken.
        """
        check_library()
        if not self.store.exists:
            remedy = "make a mesh: rmpa trust init; or join one: rmpa trust join TOKEN"
            raise StartError(f"the module {self.name}", "has joined no secured mesh", remedy)
        from rmpa.runtime.loop import SystemClock
        from rmpa.trust.membership import Membership

        return Membership.load(self.store, SystemClock(), time.time)

    def authority(self, membership: Membership) -> MeshAuthority:
        """What the files say, without the agent, of the authority.

        Raises:
            StartError: This module is not it, or a file is broken.
        """
        from rmpa.trust.authority import MeshAuthority

        if not self.store.is_authority:
            place = self.store.load_authority()
            where = f"do it at {place.name}" if place is not None and place.name else "do it at the authority"
            raise StartError(f"the module {self.name}", "is not the authority of its mesh", where)
        return MeshAuthority.load(self.store, membership)


def find_place(name: str | None, file: str | None) -> TrustPlace:
    """The module that a user means.

    Args:
        name: As given; ``None``: as ``config.module_name`` chooses it.
        file: The settings' file; ``None`` for the usual places.

    Raises:
        RmpaError: As ``find_module``; or there is no place for files.
    """
    module = find_module(name, {"config": file}, os.environ)
    if module.state is None:
        raise StartError("the state directory", "is not known: there is no home", "set RMPA_STATE_DIR")
    return TrustPlace(module.chosen, TrustStore(module.state, module.name), module.state, module.socket)


def keep_member_name(place: TrustPlace, file: str | None) -> str:
    """Keep the name of a module that has keys now as that of this machine; return the command that starts it.

    The name of another module that has keys itself stays. A gateway's is none of a module.
    """
    if place.name.endswith(GATEWAY_SUFFIX):
        return f"rmpa gateway --name {place.name}"
    try:
        kept = kept_name(place.state)
        stays = bool(kept) and kept != place.name and TrustStore(place.state, kept).exists
        if not stays:
            keep_name(place.state, place.name, instead=True)
        note_state_dir(os.environ, place.state)
        usual = load_settings({"config": file}, os.environ, host_name=socket.gethostname()).settings.name
    except RmpaError as error:
        warn(f"the name {place.name} is not kept: {error}")
        usual = ""
    return "rmpa up" if usual == place.name else f"rmpa up --name {place.name}"


def check_library() -> None:
    """Raise ``StartError`` if the library for certificates is missing."""
    try:
        import cryptography  # noqa: F401
    except ModuleNotFoundError:
        raise StartError(
            "rmpa trust", "the library cryptography is not installed", "pip install 'rmpa[trust]'"
        ) from None


def confirm(question: str) -> bool:
    """Ask the user on the terminal, on standard error, also where standard input is used up; no answer is a no.

    Raises:
        ConfigError: There is nothing to read an answer from.
    """
    click.echo(f"{question} [y/N] ", err=True, nl=False)
    line = sys.stdin.readline()
    if not line:
        try:
            with Path("/dev/tty").open(encoding="utf-8") as terminal:
                line = terminal.readline()
        except OSError:
            click.echo(err=True)
            raise ConfigError("the question", "has no answer: there is no terminal", "add --yes") from None
    return line.strip().lower() in {"y", "yes"}


def date_of(wall: float) -> str:
    """A time for people: ``2026-11-22 21:43``."""
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(wall))


def grouped(digits: str) -> str:
    """A code or fingerprint in groups, so that people can compare it."""
    size = 3 if len(digits) == 6 else 4
    return " ".join(digits[i : i + size] for i in range(0, len(digits), size))
