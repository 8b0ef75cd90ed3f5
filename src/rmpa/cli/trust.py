"""``rmpa trust``: this module's part in a secured mesh, and what others may do here."""

from __future__ import annotations

import functools
import os
import socket
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from rmpa.cli.module import agent_settings, find_module
from rmpa.cli.options import Options, argument, config_option, flag, json_verb, peers
from rmpa.cli.output import Table, confirm, duration, warn
from rmpa.cli.units import STATE
from rmpa.config import module_name
from rmpa.config.peer_rules import ACTION_CLIENT, ACTION_SERVER, Access
from rmpa.config.read import load_settings
from rmpa.core.errors import ConfigError, RmpaError, StartError
from rmpa.core.identity import is_global_name, peer_name_problem
from rmpa.runtime.systemd import restart_text
from rmpa.trust.permissions import Permissions, TrustReply, TrustStatus, action_topics
from rmpa.trust.store import TrustStore, keys_elsewhere, modules_with_keys

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.cli.module import Module
    from rmpa.cli.output import Text

# The codes of files that this user cannot use.
_CLOSED: Final = ("keys-unusable", "directory-unusable")
_WORDS: Final = (*(access.value for access in Access), ACTION_CLIENT, ACTION_SERVER)


def trust_verb(*parameters: Any) -> Callable[[Callable[..., None]], click.Command]:
    """A ``json_verb`` with ``--name`` and ``--config``, whose function gets the module that they mean."""
    name_option = click.option(
        "--name",
        metavar="NAME",
        help="This module. [default: RMPA_AGENT, RMPA_NAME, rmpa.toml, the agent that runs; else as rmpa up has it]",
    )

    def decorate(function: Callable[..., None]) -> click.Command:
        @functools.wraps(function)
        def command(name: str | None, config: str | None, options: Options, **given: Any) -> None:
            module = find_module(name, {"config": config}, os.environ)
            try:
                function(module, options, **given)
            except StartError as error:
                if not (os.geteuid() and module.state == Path(STATE) and error.code in _CLOSED):
                    raise
                words = click.get_current_context().command_path
                problem, remedy = f"the keys of {module.name} are the service's", f"sudo {words} …"
                raise StartError(words, problem, remedy, code="root-needed") from None

        return json_verb(*parameters, name_option, config_option)(command)

    return decorate


def keep_member_name(module: Module) -> str:
    """Keep the name of a module that has keys now as that of this machine; return the command that starts it.

    The name of another module that has keys itself stays. A gateway's is none of a module.
    """
    if unnoted := module_name.note_state_dir(module.place):
        missed = f"a start without RMPA_STATE_DIR={module.place} will miss these keys: {unnoted}"
        warn(f"{missed}; write require = true into [trust] of rmpa.toml", "directory-unusable")
    if module.name.endswith(module_name.GATEWAY_SUFFIX):
        return f"rmpa gateway --name {module.name}"
    usual = ""
    try:
        kept = module_name.kept_name(module.place)
        if not kept or kept == module.name or not TrustStore(module.place, kept).exists:
            module_name.keep_name(module.place, module.name, instead=True)
        config = {"config": module.loaded.settings.config_file}
        usual = load_settings(config, os.environ, host_name=socket.gethostname()).settings.name
    except RmpaError as error:
        warn(f"the name {module.name} is not kept: {error}", "directory-unusable")
    return "rmpa up" if usual == module.name else f"rmpa up --name {module.name}"


def date_of(wall: float) -> str:
    """A time for people: ``2026-11-22 21:43``."""
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(wall))


def grouped(digits: str) -> str:
    """A fingerprint in groups of four digits, so that people can compare it."""
    return " ".join(digits[i : i + 4] for i in range(0, len(digits), 4))


@json_verb(
    argument("peer", peers),
    argument("what", type=click.Choice(_WORDS), metavar="ACCESS"),
    argument("name"),
    config_option,
)
@click.pass_context
def trust_check(ctx: click.Context, peer: str, what: str, name: str, config: str | None, options: Options) -> None:
    """Say whether the [[permission]] rules of this module let PEER do something here, and which rule decides.

    PEER is a module, a site, ros2, or web for the clients of rmpa web. Without --config the rules are those that the
    agent has read. The exit code is 0 for yes and 1 for no. [bridge], [[peer]], [services] and [params] must allow it
    too.

    ---

    Examples:
      rmpa trust check joystick publish /cmd_vel
      rmpa trust check joystick action /arm/move --config new.toml
    """
    if problem := peer_name_problem(peer):
        raise ConfigError("PEER", problem)
    if not is_global_name(name):
        raise ConfigError("NAME", f"{name!r} is not a global name", "one looks like /cmd_vel")
    module = find_module(None, {"config": config}, os.environ)
    loaded = module.loaded if config else agent_settings(module)
    permissions = Permissions(loaded.settings.trust)
    action = what in (ACTION_CLIENT, ACTION_SERVER)  # five accesses in one
    asked = action_topics(what, name) if action else [(Access[what.upper()], name)]
    decisions = [permissions.judge(access, peer, each) for access, each in asked]
    decision = next((each for each in decisions if not each.allowed), decisions[0])
    files = sorted({str(given.path) for given in loaded.given.values() if given.path is not None})
    shown = {"allowed": decision.allowed, "rule": decision.rule, "number": decision.number}
    text = f"{'yes' if decision.allowed else 'no'}: {decision.rule}"
    options.show({**shown, "groups": permissions.groups_of(peer), "files": files}, text)
    if not files and not options.as_json:
        warn("no rmpa.toml was found here; --config names the file that rmpa up was started with", "doubtful-setting")
    ctx.exit(0 if decision.allowed else 1)


@trust_verb(
    click.option("--label", metavar="TEXT", default="", help="A name for the mesh, which its certificates contain.")
)
def trust_init(module: Module, options: Options, label: str) -> None:
    """Make a secured mesh. This module becomes its authority: it invites, renews and revokes.

    Only for that its key is needed: while certificates are valid, links come up without the authority.

    ---
    Exit codes: 0 done; 1 not done, with the reason on stderr; 2 a wrong option or name.

    Examples:
      rmpa trust init
      rmpa trust init --name base --label 'warehouse 3'
    """
    module.refuse_member("removes it")
    from rmpa.trust.membership import found_mesh

    found_mesh(module.store, module.name, label or module.name, time.time())
    status, start = _status(module), keep_member_name(module)

    def text() -> Iterator[str]:
        yield f"{module.name} is the authority of a new mesh; its files are in {module.store.folder}"
        yield f"fingerprint of the CA: {grouped(status.fingerprint)}"
        yield "Keep a copy of that folder in a safe place: without ca.key no module can join or be renewed."
        if module.socket is not None:
            warn(module.restart(start), "needs-restart")
        first = "" if module.socket is not None else f"{start} here, and "
        yield f"Next: {first}rmpa trust invite for each module."
        yield "Modules may do here only what [[permission]] in rmpa.toml allows: docs/guides/trust.md#permissions"

    options.show(status, text())


@trust_verb()
def trust_status(module: Module, options: Options) -> None:
    """Show this module's part in its mesh: certificate, keys, deny list; at the authority also members and tokens.

    The exit code is also 0 if trust is off.

    ---
    Exit codes: 0 done; 1 not done, with the reason on stderr; 2 a wrong option or name.

    Examples:
      rmpa trust status
      rmpa trust status --json | jq .expires
    """
    shown = _status(module)

    def text() -> Iterator[Text]:
        if shown.on:
            yield _mesh(shown)
        else:
            yield f"trust is off: {module.chosen} has joined no secured mesh"
            if others := modules_with_keys(module.place):
                status = f"rmpa trust status --name {others[0]}"
                yield f"with keys in {module.place}: {', '.join(others)}; {status}"
            for place, there in keys_elsewhere(module.state, os.environ):
                others += there
                yield f"with keys in {place}: {', '.join(there)}; RMPA_STATE_DIR={place} rmpa trust status"
            if not others:
                yield "make one: rmpa trust init; or join one: rmpa trust join TOKEN"
        for problem in shown.problems:
            warn(problem, "certificate-trouble")

    options.show(shown, text())


def _status(module: Module) -> TrustStatus:
    """The state by the agent, or by the files if none runs."""
    if module.trust is not None and (module.trust.agent == "secured" or not module.store.exists):
        return module.trust
    if not module.store.exists:
        return TrustStatus(on=False, module=module.name, folder=str(module.store.folder), agent=module.agent)
    from msgspec.structs import replace

    from rmpa.trust.joining import status_of

    authority = module.authority() if module.store.is_authority else None
    membership = authority.membership if authority is not None else module.membership()
    shown = status_of(membership, authority, agent=module.agent)
    restart = (module.restart(),) if module.agent == "plain" else ()
    return replace(shown, problems=(*shown.problems, *restart))


def _mesh(shown: TrustStatus) -> Iterator[str | Table]:
    now = time.time()
    yield shown.module + (
        ", the authority" if shown.is_authority else f"; authority: {shown.authority or 'not known yet'}"
    )
    left = duration(shown.expires - now) if shown.expires > now else "ended"
    yield f"certificate: valid until {date_of(shown.expires)} ({left}), renewed from {date_of(shown.renew_at)}"
    yield f"CA: {grouped(shown.fingerprint)}"
    yield f"group key {shown.key}; deny list {shown.deny_number}: {', '.join(shown.revoked) or 'none'}"
    yield f"agent: {shown.agent}; files: {shown.folder}"
    words = {True: "linked", False: "not linked", None: "-"}
    members = [(m.name, words[m.linked], date_of(m.issued), date_of(m.expires)) for m in shown.members]
    tokens = [(t.id[:8], t.state, t.used_by or t.name or "any module", date_of(t.expires)) for t in shown.tokens]
    for titles, rows in (("MODULE, STATE, ISSUED, EXPIRES", members), ("TOKEN, STATE, MODULE, EXPIRES", tokens)):
        if rows:
            yield ""
            yield Table(titles, rows)


@trust_verb(flag("--group-key", help="At the authority: make a new group key; links stay up."))
def trust_renew(module: Module, options: Options, group_key: bool) -> None:
    """Renew this module's certificate now. Agents do it by themselves after half of its time.

    A module that was off for up to a year can renew with its key; the authority must be reachable.

    ---
    Exit codes: 0 done; 1 not done, with the reason on stderr; 2 a wrong option or name.

    Examples:
      rmpa trust renew               after the authority was away
      rmpa trust renew --group-key   at the authority: a new group key for all
    """
    if module.agent == "secured":
        reply = module.call("rotate" if group_key else "renew", TrustReply)
    elif group_key:
        reply = TrustReply(module=module.name, done=True, number=module.authority().rotate())
    else:
        reply = TrustReply(module=module.name, done=True, expires=_renew_files(module))
    done = f"{reply.module} has a new certificate until {date_of(reply.expires)}"
    if group_key:
        done = f"group key {reply.number} is made; all linked modules get it, and use it in 30 s"
    options.show(reply, done)


def _renew_files(module: Module) -> int:
    """Renew without an agent: the authority by its own key, others by a connection to it; return when it ends."""
    if module.store.is_authority:
        authority = module.authority()
        authority.renew_own()
        return int(authority.membership.certificate.expires)
    import asyncio

    from rmpa.trust.joining import renew_at_authority

    membership, known = module.membership(), module.store.load_authority()
    if known is None:
        problem = "was never linked with this module: its address is not known"
        remedy = "start the agent (rmpa up), or join again: rmpa trust invite at the authority"
        raise StartError("the authority", problem, remedy, code="not-a-member")
    asyncio.run(renew_at_authority(membership, known.address, known.port))
    return int(membership.certificate.expires)


@trust_verb(
    argument("target", metavar="MODULE"), flag("--force", help="Also if no certificate of that name is known here.")
)
def trust_revoke(module: Module, options: Options, target: str, force: bool) -> None:
    """Exclude MODULE from the mesh, at the authority: its certificates are refused everywhere from now on.

    All linked modules get the deny list and a new group key within a second; others when they are linked again.
    It may come back with a new token.

    ---
    Exit codes: 0 done; 1 not done, with the reason on stderr; 2 a wrong option or name.

    Examples:
      rmpa trust revoke arm2          its links end everywhere at once
      rmpa trust revoke arm2 --force  also if no certificate of it is known here
    """
    if module.agent == "secured":
        reply = module.call("revoke", TrustReply, name=target, force=force)
    else:
        deny = module.authority().revoke_known(target, force=force)
        reply = TrustReply(module=target, done=True, number=deny.number)
    options.show(reply, f"{target} is revoked (deny list {reply.number}); there is a new group key")
    if module.socket is None and not options.as_json:
        warn("no agent runs here: the other modules learn it when it is started (rmpa up)", "no-agent")


@trust_verb(flag("--yes", help="Do not ask."))
def trust_leave(module: Module, options: Options, yes: bool) -> None:
    """Remove this module's keys and certificate: after that its agent starts without trust.

    At the authority this ends the whole mesh: certificates cannot be renewed, and end after a week.

    ---
    Exit codes: 0 done; 1 not done, with the reason on stderr; 2 a wrong option or name.

    Examples:
      rmpa trust leave
      rmpa trust leave --yes   in a script
    """
    if not module.store.exists:
        raise module.refused("has joined no secured mesh", "there is nothing to remove", "not-a-member")
    is_authority = module.store.is_authority
    what = "the AUTHORITY's keys: the mesh ends when its certificates do" if is_authority else "its keys"
    if not yes and not confirm(f"Remove {module.name} from its mesh, with {what}?"):
        raise ConfigError("rmpa trust leave", "nothing was removed", code="not-confirmed")
    removed = module.store.remove()
    done = f"{module.name} has left its mesh: {len(removed)} files are removed"
    options.show(TrustReply(module=module.name, done=True, text=", ".join(removed)), done)
    if module.socket is not None and not options.as_json:
        how = restart_text(module.pid)
        warn(f"the agent {module.name} keeps its membership until you restart it: {how}", "needs-restart")
