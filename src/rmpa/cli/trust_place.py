"""The module that ``rmpa trust`` is about: its settings, its files, and its agent if that runs."""

from __future__ import annotations

import os
import socket
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import click

from rmpa.config.sources import load_settings
from rmpa.core.errors import ConfigError, StartError, UnreachableError
from rmpa.core.identity import peer_name_problem
from rmpa.observe.io.control_client import ControlClient, find_agents
from rmpa.runtime.state_dir import state_dir
from rmpa.trust.io.store import TrustStore
from rmpa.trust.status import TrustStatus

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    from rmpa.trust.io.authority import MeshAuthority
    from rmpa.trust.io.membership import Membership

_T = TypeVar("_T")
name_option = click.option(
    "--name", metavar="NAME", help="This module. [default: the only agent that runs here; else as rmpa up has it]"
)
config_option = click.option(
    "--config", "file", metavar="FILE", help="Settings. [default: ./rmpa.toml, ~/.config/rmpa, /etc/rmpa]"
)


@dataclass(frozen=True, slots=True)
class TrustPlace:
    """One module.

    Args:
        name: Its name.
        store: Its files.
        socket: The control socket of its agent; ``None``: none runs.
    """

    name: str
    store: TrustStore
    socket: Path | None

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
        from rmpa.runtime.system_clock import SystemClock
        from rmpa.trust.io.membership import Membership

        return Membership.load(self.store, SystemClock(), time.time)

    def authority(self, membership: Membership) -> MeshAuthority:
        """What the files say, without the agent, of the authority.

        Raises:
            StartError: This module is not it, or a file is broken.
        """
        from rmpa.trust.io.authority import MeshAuthority

        if not self.store.is_authority:
            place = self.store.load_authority()
            where = f"do it at {place.name}" if place is not None and place.name else "do it at the authority"
            raise StartError(f"the module {self.name}", "is not the authority of its mesh", where)
        return MeshAuthority.load(self.store, membership)


def find_place(name: str | None, file: str | None) -> TrustPlace:
    """The module that a user means.

    Args:
        name: As given; ``None``: RMPA_AGENT, the name in the settings, the only agent that runs, or the host's name.
        file: The settings' file; ``None`` for the usual places.

    Raises:
        ConfigError: The name cannot be one, or a setting cannot be used.
        StartError: There is no place for files.
    """
    environ = dict(os.environ)
    loaded = load_settings({"config": file}, environ, host_name=socket.gethostname())
    agents = {agent.name: agent.path for agent in find_agents(environ)}
    wanted = name or environ.get("RMPA_AGENT") or ""
    if problem := peer_name_problem(wanted) if wanted else "":
        raise ConfigError("--name", problem)
    if not wanted:
        only = next(iter(agents)) if len(agents) == 1 and "name" not in loaded.given else ""
        wanted = only or loaded.settings.name
    socket_path = agents.get(wanted)
    folder = ""
    if socket_path is not None:  # it may have been started with another state directory than this shell has
        with ControlClient(socket_path) as client:
            folder = client.call("trust", TrustStatus, what="status").folder
    place = Path(folder).parent.parent if folder else state_dir(environ, loaded.settings.state_dir)
    if place is None:
        raise StartError("the state directory", "is not known: there is no home", "set RMPA_STATE_DIR")
    return TrustPlace(wanted, TrustStore(place, wanted), socket_path)


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


def asked(loop: asyncio.AbstractEventLoop, ask: Callable[[], bool]) -> asyncio.Future[bool]:
    """The answer to a question, asked in a thread that does not keep the program from ending."""
    answer: asyncio.Future[bool] = loop.create_future()

    def finish(value: bool | BaseException) -> None:
        if answer.done():
            return
        if isinstance(value, BaseException):
            answer.set_exception(value)
        else:
            answer.set_result(value)

    def run() -> None:
        try:
            found: bool | BaseException = ask()
        except BaseException as error:  # noqa: BLE001 - handed to the loop
            found = error
        if not loop.is_closed():
            loop.call_soon_threadsafe(finish, found)

    threading.Thread(target=run, name="question", daemon=True).start()
    return answer


def date_of(wall: float) -> str:
    """A time for people: ``2026-11-22 21:43``."""
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(wall))


def grouped(digits: str) -> str:
    """A code or fingerprint in groups, so that people can compare it."""
    size = 3 if len(digits) == 6 else 4
    return " ".join(digits[i : i + size] for i in range(0, len(digits), size))
