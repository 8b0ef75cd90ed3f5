"""``rmpa trust``: what other modules may do here."""

from __future__ import annotations

import os
import socket
from typing import TYPE_CHECKING, Final

import click

from rmpa.cli.options import completes, json_option
from rmpa.cli.output import print_json, printable, warn
from rmpa.config.peer_rules import ACTION_CLIENT, ACTION_SERVER, Access
from rmpa.config.read import load_settings
from rmpa.core.errors import ConfigError
from rmpa.core.identity import is_global_name, peer_name_problem
from rmpa.trust.documents import Permissions, action_topics

if TYPE_CHECKING:
    from rmpa.trust.documents import PermissionDecision

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
