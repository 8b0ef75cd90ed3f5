"""``rmpa trust``: this module's part in a secured mesh, how modules join it, and what others may do here."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import sys
import time
from base64 import b64encode
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click
import msgspec

from rmpa.cli.module import Module, agent_settings, check_library, find_module, keep_member_name, module_verb
from rmpa.cli.options import Options, argument, config_option, flag, json_verb, option, peers
from rmpa.cli.output import Table, Text, confirm, duration, print_json, warn
from rmpa.config.peer_rules import ACTION_CLIENT, ACTION_SERVER, Access
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError, StartError
from rmpa.core.identity import is_global_name, peer_name_problem
from rmpa.runtime.systemd import restart_text
from rmpa.trust import limits
from rmpa.trust.permissions import (
    InviteReply,
    JoinStep,
    Permissions,
    TrustError,
    TrustReply,
    TrustStatus,
    action_topics,
)
from rmpa.trust.store import MemberFiles, keys_elsewhere, modules_with_keys

if TYPE_CHECKING:
    from collections.abc import Iterator


_LIFETIME: Final = re.compile(r"([0-9]{1,6})\s*(s|min|h|d)")
_UNITS: Final = {"s": 1, "min": 60, "h": 3600, "d": 86_400}
_FINGERPRINT: Final = 2 * limits.FINGERPRINT_BYTES
_WORDS: Final = (*(access.value for access in Access), ACTION_CLIENT, ACTION_SERVER)


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


@module_verb(option("--label", "TEXT", "A name for the mesh, which its certificates contain.", default=""))
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


@module_verb()
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


@module_verb(flag("--group-key", "At the authority: make a new group key; links stay up."))
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


@module_verb(
    argument("target", metavar="MODULE"), flag("--force", "Also if no certificate of that name is known here.")
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


@module_verb(flag("--yes", "Do not ask."))
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


@module_verb(
    option("--for lifetime", "TIME", "Validity: 90s, 15min, 2h, 3d. [default: 15min]", default="15min"),
    option(
        "--module invitee", "MODULE", "Only this module may use it; it may be one that joins again. [default: any]"
    ),
    option("--address", "HOST[:PORT]", "Where the module reaches this one. [default: as other agents do]"),
    flag("--yes", "With --sign: do not ask."),
    flag("--no-wait", "Print the token and end."),
    option("--sign", "FILE", "Answer the request of rmpa trust join --request; no token is made."),
    option("--out", "FILE", "Where --sign writes the answer, a secret. [default: FILE.answer]"),
)
def trust_invite(
    module: Module,
    options: Options,
    lifetime: str,
    invitee: str | None,
    address: str | None,
    yes: bool,
    no_wait: bool,
    sign: str | None,
    out: str | None,
) -> None:
    """Invite a module, at the authority: print a token that is valid once, and wait until it has joined.

    On a terminal the line to run on the new module is printed, with the token; else only the token, on standard
    output. The holder of the token can join: keep it secret.

    ---
    With --json one object a line is printed: the token, then each step, whose state is refused or joined. A token
    that was refused is still valid.

    Exit codes: 0 done; 1 not done, with the reason on stderr; 2 a wrong option or name.

    Examples:
      rmpa trust invite                          print the line for the new module, and wait
      rmpa trust invite --module arm2 --for 2d   for one module, valid for two days
      rmpa trust invite --no-wait | ssh arm2 rmpa trust join -
                                                 by a script
      rmpa trust invite --sign arm2.csr          answer a join by files
    """
    if invitee and (problem := peer_name_problem(invitee)):
        raise ConfigError("--module", problem)
    seconds = _seconds(lifetime)
    host, port = _address(address)
    if sign is not None:
        _sign(module, Path(sign), Path(out or f"{sign}.answer"), invitee or "", options, yes=yes)
        return
    if module.agent != "secured":
        module.authority()  # the better error, if this module is none
        problem, remedy = "does not run", "start it: rmpa up"
        if module.socket is not None:
            problem, remedy = "runs without its keys", f"restart it: {restart_text(module.pid)}"
        raise StartError(f"the agent {module.name}", f"{problem}, so no module can join", remedy, code="not-a-member")
    invited = module.call("invite", InviteReply, name=invitee or "", lifetime=seconds, address=host, port=port)
    for number in () if no_wait else (signal.SIGHUP, signal.SIGTERM):  # its terminal is closed, too
        signal.signal(number, signal.default_int_handler)
    try:
        if not options.as_json:
            until = date_of(invited.expires)
            click.echo(f"for {invitee or 'one module'}, valid once, until {until}; run there:", err=True)
        named = f" --name {invitee}" if invitee else ""
        options.show(invited, f"rmpa trust join{named} {invited.token}" if sys.stdout.isatty() else invited.token)
        sys.stdout.flush()
        if not no_wait:
            _await_join(module, invited, as_json=options.as_json)
    except (KeyboardInterrupt, click.Abort):
        with contextlib.suppress(RmpaError):
            if module.call("withdraw", TrustReply, id=invited.id).done:
                click.echo("\nthe token is withdrawn", err=True)
        raise


def _await_join(module: Module, invited: InviteReply, *, as_json: bool) -> None:
    """Wait until a module has joined with the token; one that was refused may try again."""
    step = JoinStep(step=0, state="waiting")
    if not as_json:
        click.echo("waiting for the module; Ctrl-C withdraws the token", err=True)
    while step.state != "joined":
        following = module.call("step", JoinStep, id=invited.id, after=step.step)
        if following.step == step.step:
            if time.time() > invited.expires:
                problem = "the token has ended, and no module came"
                raise PeerRefused("the authority", problem, "rmpa trust invite again", code="token-refused")
            continue
        step = following
        if as_json:
            print_json(step)
        elif step.state == "refused":
            warn(f"{step.module} was refused: {step.text} ({step.reason}); the token is still valid", "token-refused")
        else:
            click.echo(f"{step.module} has joined", err=True)


def _sign(module: Module, request: Path, out: Path, invitee: str, options: Options, *, yes: bool) -> None:
    """Answer a join by files."""
    check_library()
    from rmpa.trust import certificates
    from rmpa.trust.membership import request_der
    from rmpa.trust.tokens import fingerprint_of

    try:
        with request.open("rb") as stream:
            data = request_der(stream.read(limits.JOIN_REQUEST_MAX))
        wanted = certificates.read_request(data)
    except OSError as error:
        raise ConfigError(str(request), f"cannot be read: {error.strerror}") from None
    except (ValueError, TrustError) as error:
        remedy = "make it by rmpa trust join --request FILE"
        raise ConfigError(str(request), f"is no request: {error}", remedy) from None
    if invitee and invitee != wanted.name:
        raise ConfigError("--module", f"is {invitee}, and the request is of {wanted.name}")
    if out.exists():  # before a certificate takes the name
        raise ConfigError(str(out), "exists already", "choose another --out, or remove it")
    key = wanted.key_hash[: limits.FINGERPRINT_BYTES].hex()
    click.echo(f"{wanted.name} asks with the key {grouped(key)}", err=True)
    if not yes and not confirm(f"Does {wanted.name} show this key?"):
        raise ConfigError("rmpa trust invite --sign", "nothing was signed", code="not-confirmed")
    if module.agent == "secured":
        reply = module.call("sign", dict[str, str], request=b64encode(data).decode(), module=invitee)
        answer = reply["answer"].encode()
    else:
        answer = msgspec.json.encode(module.authority().join_file(data, invitee)[1])
    _write_secret(out, answer)
    ca = fingerprint_of(module.membership().files.ca).hex()
    options.show(
        {"module": wanted.name, "key": key, "file": str(out)},
        f"{out} is the answer, a secret: bring it to {wanted.name}, and delete it then",
        f"there: rmpa trust join --accept {out.name} --ca {ca} --name {wanted.name}",
    )


def _write_secret(path: Path, data: bytes) -> None:
    """Write a new file that only this user can read."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(data)
    except FileExistsError:
        raise ConfigError(str(path), "exists already", "choose another --out, or remove it") from None
    except OSError as error:
        raise StartError(str(path), f"cannot be written: {error.strerror}", code="directory-unusable") from None


def _seconds(text: str) -> float:
    match = _LIFETIME.fullmatch(text.strip())
    seconds = int(match[1]) * _UNITS[match[2]] if match else 0
    if not 0 < seconds <= limits.TOKEN_LIFETIME_MAX:
        most = limits.TOKEN_LIFETIME_MAX / 86_400
        raise ConfigError("--for", f"{text!r} is not a time up to {most:.0f} d", "write 90s, 15min, 2h or 3d")
    return float(seconds)


def _address(text: str | None) -> tuple[str, int | None]:
    """The host as an IPv4 address, and the port, of ``--address``; empty and ``None`` where it is not given."""
    if text is None:
        return "", None
    host, _, port = text.partition(":")
    if port and not (port.isascii() and port.isdigit() and 0 < int(port) < 65_536):
        raise ConfigError("--address", f"{port!r} is no port", "write HOST or HOST:PORT")
    try:
        return socket.gethostbyname(host), int(port) if port else None
    except OSError as error:
        raise ConfigError("--address", f"{host!r} has no IPv4 address: {error}") from None


@module_verb(
    argument("token", required=False),
    option("--request", "FILE", "Join by files: write the request."),
    option("--accept", "FILE", "Join by files: read the answer."),
    option("--ca", "FINGERPRINT", "With --accept: the fingerprint of the CA, as rmpa trust invite --sign shows it."),
)
def trust_join(
    module: Module, options: Options, token: str | None, request: str | None, accept: str | None, ca: str | None
) -> None:
    """Join a secured mesh with a TOKEN of rmpa trust invite; - reads it from standard input.

    The token proves each side to the other: a third machine between them cannot join or listen without it.

    ---
    Exit codes: 0 done; 1 not done, with the reason on stderr; 2 a wrong option or name.

    Examples:
      rmpa trust join rmpa1-...                 with a token of rmpa trust invite
      rmpa trust join -                         the token from standard input, not in the process list
      rmpa trust join --request arm2.csr        offline: bring this file to the authority ...
      rmpa trust join --accept arm2.csr.answer --ca 4f2a...   ... and its answer back
    """
    if sum(each is not None for each in (token, request, accept)) != 1:
        raise ConfigError("rmpa trust join", "needs a TOKEN, --request or --accept", "see rmpa trust join --help")
    module.refuse_member("first, to join again")
    if request is not None:
        _write_request(module, Path(request), options)
        return
    files = _accepted(module, Path(accept), ca) if accept is not None else _join_by_token(module, token or "")
    module.store.save(files)
    module.store.forget("request.key")
    start = keep_member_name(module)
    from rmpa.trust.certificates import read_certificate

    found = read_certificate(files.certificate, files.ca)
    done = f"{found.name} has joined; its certificate ends {date_of(found.expires)}, and renews itself before"
    options.show(TrustReply(module=found.name, done=True, expires=int(found.expires)), done)
    if options.as_json:
        return
    if text := _clock_problem(time.time(), found.issued, by_files=accept is not None):
        warn(text, "clock-skew")
    if module.socket is not None:
        warn(module.restart(start), "needs-restart")
    else:
        click.echo(f"Next: {start}; what a module may do here: rmpa trust check PEER publish /TOPIC")


def _clock_problem(wall: float, issued: float, *, by_files: bool) -> str:
    """What is wrong with this machine's clock, by a certificate that was issued just now; empty: nothing."""
    off = wall - issued
    if abs(off) <= limits.CLOCK_TOLERANCE or (by_files and off > 0):
        return ""
    here = f"the clock of this machine shows {date_of(wall)}, the authority's {date_of(issued)}"
    if off < -limits.CERTIFICATE_BACKDATE:
        return f"{here}: it counts as not set, and no times are checked until it is (timedatectl, chrony)"
    return f"{here}: links are refused while they differ by more than {limits.CLOCK_TOLERANCE:.0f} s; set it"


def _join_by_token(module: Module, text: str) -> MemberFiles:
    import asyncio

    from rmpa.trust.joining import join_mesh
    from rmpa.trust.store import AuthorityPlace
    from rmpa.trust.tokens import Token, TokenError

    try:
        token = Token.parse(sys.stdin.readline() if text == "-" else text)
    except TokenError as error:
        raise ConfigError("TOKEN", str(error), code="token-refused") from None
    module.store.check_writable()  # before the token is used up
    files = asyncio.run(join_mesh(token, module.name))
    module.store.save_authority(AuthorityPlace("", str(token.address), token.port))
    return files


def _write_request(module: Module, out: Path, options: Options) -> None:
    from rmpa.trust import certificates
    from rmpa.trust.membership import new_key, private_key, request_pem
    from rmpa.trust.store import REQUEST_KEY

    pem = new_key()
    request = certificates.make_request(private_key(pem, REQUEST_KEY), module.name)
    key = certificates.read_request(request).key_hash[: limits.FINGERPRINT_BYTES].hex()
    module.store.write(REQUEST_KEY, pem)
    try:
        out.write_bytes(request_pem(request))
    except OSError as error:
        raise StartError(str(out), f"cannot be written: {error.strerror}", code="directory-unusable") from None
    options.show(
        {"module": module.name, "key": key, "file": str(out)},
        f"{out} is the request of {module.name}, with the key {grouped(key)}; it is no secret",
        f"at the authority: rmpa trust invite --sign {out.name}",
    )


def _accepted(module: Module, path: Path, ca: str | None) -> MemberFiles:
    """The files of the answer in a join by files.

    Raises:
        ConfigError: It is no answer, or of another authority, another module or another key.
    """
    from rmpa.trust import certificates
    from rmpa.trust.joining import check_grant
    from rmpa.trust.membership import private_key
    from rmpa.trust.store import REQUEST_KEY, MemberFiles
    from rmpa.trust.tokens import CertificateGrant

    digits = re.sub(r"[\s:]", "", ca or "").lower()
    if not re.fullmatch(rf"[0-9a-f]{{{_FINGERPRINT}}}", digits):
        raise ConfigError("--ca", f"is not {_FINGERPRINT} hexadecimal digits", "rmpa trust invite --sign shows them")
    pem = module.store.load_request_key()
    own = certificates.make_request(private_key(pem, REQUEST_KEY), module.name)
    try:
        with path.open("rb") as stream:
            answer = msgspec.json.decode(stream.read(limits.JOIN_ANSWER_MAX + 1), type=CertificateGrant)
        certificates.check_ca(answer.ca, bytes.fromhex(digits))
        check_grant(answer, module.name, own)
    except OSError as error:
        raise ConfigError(str(path), f"cannot be read: {error.strerror}") from None
    except (msgspec.MsgspecError, UnicodeError) as error:
        raise ConfigError(str(path), f"is no answer of rmpa trust invite --sign: {error!s:.100}") from None
    except TrustError as error:
        text = str(error).replace("of the token", "of --ca")
        raise ConfigError(str(path), text, "is it the answer to this module's last request?") from None
    return MemberFiles(pem, answer.certificate, answer.ca, answer.keys, answer.deny)
