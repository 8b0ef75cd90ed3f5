"""``rmpa trust``: a mesh's authority, this module's membership, and what others may do here.

``rmpa trust``: what other modules may do here.
"""

from __future__ import annotations

import os
import socket
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

import click

from rmpa.cli.agent import find_module
from rmpa.cli.options import completes, json_option
from rmpa.cli.output import Column, duration, print_json, print_line, print_table, printable, warn
from rmpa.config.module_name import GATEWAY_SUFFIX, keep_name, kept_name, note_state_dir
from rmpa.config.peer_rules import ACTION_CLIENT, ACTION_SERVER, Access
from rmpa.config.read import load_settings
from rmpa.core.errors import ConfigError, RmpaError, StartError, UnreachableError
from rmpa.core.identity import is_global_name, peer_name_problem
from rmpa.observe.control_client import ControlClient
from rmpa.trust.permissions import Permissions, TrustReply, TrustStatus, action_topics
from rmpa.trust.store import TrustStore, modules_with_keys

if TYPE_CHECKING:
    from rmpa.config.module_name import ModuleName
    from rmpa.trust.authority import MeshAuthority
    from rmpa.trust.membership import Membership
    from rmpa.trust.permissions import PermissionDecision

_WORDS: Final = (*(access.value for access in Access), ACTION_CLIENT, ACTION_SERVER)


@click.command(
    epilog="\b\nExamples:\n  rmpa trust check joystick publish /cmd_vel\n"
    "  rmpa trust check joystick action /arm/move --config new.toml\n"
)
@click.argument("peer", shell_complete=completes("peer"))
@click.argument("what", type=click.Choice(_WORDS), metavar="|".join(_WORDS))
@click.argument("name")
@click.option("--config", "file", metavar="FILE", help="Settings. [default: ./rmpa.toml, ~/.config/rmpa, /etc/rmpa]")
@json_option
@click.pass_context
def check(ctx: click.Context, peer: str, what: str, name: str, file: str | None, as_json: bool) -> None:
    """Say whether the [[permission]] of this module let PEER do something here, and which of them decides.

    The exit code is 0 for yes and 1 for no. What [bridge], [[peer]], [services] and [params] say comes on top.
    """
    if problem := peer_name_problem(peer):
        raise ConfigError("PEER", problem)
    if not is_global_name(name):
        raise ConfigError("NAME", f"{name!r} is not a global name", "one looks like /cmd_vel")
    loaded = load_settings({"config": file}, dict(os.environ), host_name=socket.gethostname())
    permissions = Permissions(loaded.settings.trust)
    decisions = [permissions.judge(access, peer, each) for access, each in _asked(what, name)]
    decision = next((each for each in decisions if not each.allowed), decisions[0])
    files = sorted({str(given.path) for given in loaded.given.values() if given.path is not None})
    _show(decision, permissions.groups_of(peer), files, as_json=as_json)
    ctx.exit(0 if decision.allowed else 1)


def _asked(what: str, name: str) -> list[tuple[Access, str]]:
    """What a user asks for, as single accesses: five for an action."""
    if what in (ACTION_CLIENT, ACTION_SERVER):
        return list(action_topics(what, name))
    return [(Access(what), name)]


def _show(decision: PermissionDecision, groups: tuple[str, ...], files: list[str], *, as_json: bool) -> None:
    if as_json:
        told = {"allowed": decision.allowed, "rule": decision.rule, "number": decision.number}
        print_json({**told, "groups": list(groups), "files": files})
        return
    click.echo(f"{'yes' if decision.allowed else 'no'}: {printable(decision.rule)}")
    if not files:
        warn("no rmpa.toml was found here; --config names the file that rmpa up was started with")


# The module that ``rmpa trust`` is about: its settings, its files, and its agent if that runs.


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
        return MeshAuthority(membership)


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


# ``rmpa trust init|status|renew|revoke|leave``: the mesh, and this module's part in it.


EXIT_CODES = "\b\nExit codes: 0 done; 1 not done, with the reason on stderr; 2 a wrong option or name.\n"
_RESTART = "the agent {} runs without trust until it is started again"


@click.command(
    epilog=f"{EXIT_CODES}\n\b\nExamples:\n  rmpa trust init\n  rmpa trust init --name base --label 'warehouse 3'\n"
)
@click.option("--label", metavar="TEXT", default="", help="What you call the mesh; it stands in its certificates.")
@name_option
@config_option
@json_option
def init(label: str, name: str | None, file: str | None, as_json: bool) -> None:
    """Make a secured mesh. This module becomes its authority: it invites, renews and revokes.

    Its key is needed for that alone: links come up without the authority, for as long as certificates are valid.
    """
    check_library()
    place = find_place(name, file)
    if place.store.exists:
        remedy = "rmpa trust status shows it; rmpa trust leave removes it"
        raise StartError(f"the module {place.name}", "is a member of a secured mesh already", remedy)
    from rmpa.trust.authority import found_mesh

    found_mesh(place.store, place.name, label or place.name, time.time())
    status, start = _status(place), keep_member_name(place, file)
    if as_json:
        print_json(status)
        return
    print_line(f"{place.name} is the authority of a new mesh; its files are in {place.store.folder}")
    print_line(f"fingerprint of the CA: {grouped(status.fingerprint)}")
    print_line("Keep a copy of that folder in a safe place: without ca.key no module can join or be renewed.")
    if place.socket is not None:
        warn(_RESTART.format(place.name))
    again = " again" if place.socket is not None else ""
    print_line(f"Next: {start} here{again}, and rmpa trust invite for each module.")
    print_line("Modules may do here only what [[permission]] in rmpa.toml allows: docs/permissions.md")


@click.command(epilog=f"{EXIT_CODES}\n\b\nExamples:\n  rmpa trust status\n  rmpa trust status --json | jq .expires\n")
@name_option
@config_option
@json_option
def status(name: str | None, file: str | None, as_json: bool) -> None:
    """Show this module's part in its mesh: certificate, keys, deny list; at the authority also members and tokens.

    The exit code is 0 too if trust is off.
    """
    place = find_place(name, file)
    shown = _status(place)
    if as_json:
        print_json(shown)
        return
    if not shown.on:
        print_line(f"trust is off: {place.chosen} has joined no secured mesh")
        if others := modules_with_keys(place.state):
            print_line(f"with keys in {place.state}: {', '.join(others)}; rmpa trust status --name {others[0]}")
        else:
            print_line("make one: rmpa trust init; or join one: rmpa trust join TOKEN")
    else:
        _show_mesh(shown)
    for problem in shown.problems:
        warn(problem)


def _status(place: TrustPlace) -> TrustStatus:
    """The state by the agent, or by the files if none runs."""
    if place.socket is not None:
        shown = place.call("status", TrustStatus)
        if shown.agent == "secured" or not place.store.exists:
            return shown
    if not place.store.exists:
        return TrustStatus(on=False, module=place.name, folder=str(place.store.folder), agent=place.agent)
    from rmpa.trust.joining import status_of

    membership = place.membership()
    authority = place.authority(membership) if place.store.is_authority else None
    agent = place.agent
    shown = status_of(membership, authority, agent=agent)
    if agent == "plain":
        from msgspec.structs import replace

        return replace(shown, problems=(*shown.problems, _RESTART.format(place.name)))
    return shown


def _show_mesh(shown: TrustStatus) -> None:
    now = time.time()
    role = ", the authority" if shown.is_authority else f"; authority: {shown.authority or 'not known yet'}"
    print_line(f"{shown.module}{role}")
    left = duration(shown.expires - now) if shown.expires > now else "ended"
    print_line(f"certificate: until {date_of(shown.expires)} ({left}), renewed from {date_of(shown.renew_at)}")
    print_line(f"CA: {grouped(shown.fingerprint)}")
    revoked = ", ".join(shown.revoked) or "none"
    print_line(f"group key {shown.key}; deny list {shown.deny_number}: {revoked}")
    print_line(f"agent: {shown.agent}; files: {shown.folder}")
    if shown.members:
        rows = [
            (
                each.name,
                {True: "linked", False: "not linked", None: "-"}[each.linked],
                date_of(each.issued),
                date_of(each.expires),
            )
            for each in shown.members
        ]
        print_line()
        print_table([Column("MODULE"), Column("STATE"), Column("ISSUED"), Column("UNTIL")], rows)
    if shown.tokens:
        rows = [
            (each.id[:8], each.state, each.used_by or each.name or "any module", date_of(each.expires))
            for each in shown.tokens
        ]
        print_line()
        print_table([Column("TOKEN"), Column("STATE"), Column("MODULE"), Column("UNTIL")], rows)


@click.command(
    epilog=f"{EXIT_CODES}\n\b\nExamples:\n  rmpa trust renew               after the authority was away\n"
    "  rmpa trust renew --group-key   at the authority: a new group key for all\n"
)
@click.option("--group-key", is_flag=True, help="At the authority: make a new group key; no link falls.")
@name_option
@config_option
@json_option
def renew(group_key: bool, name: str | None, file: str | None, as_json: bool) -> None:
    """Renew this module's certificate now. Agents do it by themselves after half of its time.

    A module that was off for up to a year is renewed too, with its key alone; it needs the authority for that.
    """
    place = find_place(name, file)
    if place.agent == "secured":
        reply = place.call("rotate" if group_key else "renew", TrustReply)
    else:
        reply = _rotate_files(place) if group_key else _renew_files(place)
    if as_json:
        print_json(reply)
    elif group_key:
        print_line(f"group key {reply.number} is made; all linked modules get it, and use it in 30 s")
    else:
        print_line(f"{reply.module} has a new certificate until {date_of(reply.expires)}")


def _rotate_files(place: TrustPlace) -> TrustReply:
    membership = place.membership()
    return TrustReply(module=place.name, done=True, number=place.authority(membership).rotate())


def _renew_files(place: TrustPlace) -> TrustReply:
    """Renew without an agent: the authority by its own key, others by a connection to it."""
    membership = place.membership()
    if place.store.is_authority:
        place.authority(membership).renew_own()
    else:
        import asyncio

        from rmpa.trust.joining import renew_at_authority

        known = place.store.load_authority()
        if known is None:
            remedy = "start the agent (rmpa up), or join again: rmpa trust invite at the authority"
            raise StartError("the authority", "was never linked with this module: its address is not known", remedy)
        asyncio.run(renew_at_authority(membership, known.address, known.port))
    return TrustReply(module=place.name, done=True, expires=int(membership.certificate.expires))


@click.command(
    epilog=f"{EXIT_CODES}\n\b\nExamples:\n  rmpa trust revoke arm2          its links end everywhere at once\n"
    "  rmpa trust revoke arm2 --force  also if no certificate of it is known here\n"
)
@click.argument("module")
@click.option("--force", is_flag=True, help="Also if no certificate of that name is known here.")
@name_option
@config_option
@json_option
def revoke(module: str, force: bool, name: str | None, file: str | None, as_json: bool) -> None:
    """Throw MODULE out of the mesh, at the authority: its certificates are refused everywhere from now on.

    All linked modules get the deny list and a new group key within a second; others when they are linked again.
    It may come back with a new token.
    """
    place = find_place(name, file)
    if place.agent == "secured":
        reply = place.call("revoke", TrustReply, name=module, force=force)
    else:
        membership = place.membership()
        deny = place.authority(membership).revoke_known(module, force=force)
        reply = TrustReply(module=module, done=True, number=deny.number)
    if as_json:
        print_json(reply)
    else:
        print_line(f"{module} is revoked (deny list {reply.number}); there is a new group key")
        if place.socket is None:
            warn("no agent runs here: the other modules learn it when it is started (rmpa up)")


@click.command(epilog=f"{EXIT_CODES}\n\b\nExamples:\n  rmpa trust leave\n  rmpa trust leave --yes   in a script\n")
@click.option("--yes", is_flag=True, help="Do not ask.")
@name_option
@config_option
@json_option
def leave(yes: bool, name: str | None, file: str | None, as_json: bool) -> None:
    """Remove this module's keys and certificate: its agent starts without trust then.

    At the authority that ends the whole mesh: nothing can be renewed after a week.
    """
    place = find_place(name, file)
    if not place.store.exists:
        raise StartError(f"the module {place.name}", "has joined no secured mesh", "there is nothing to remove")
    if not yes:
        what = (
            "the AUTHORITY's keys: the mesh ends when its certificates do" if place.store.is_authority else "its keys"
        )
        if not confirm(f"Remove {place.name} from its mesh, with {what}?"):
            raise ConfigError("rmpa trust leave", "nothing was removed")
    removed = place.store.remove()
    secured = place.socket is not None
    if as_json:
        print_json(TrustReply(module=place.name, done=True, text=", ".join(removed)))
        return
    print_line(f"{place.name} has left its mesh: {len(removed)} files are removed")
    if secured:
        warn(f"the agent {place.name} keeps its membership until it is started again")
