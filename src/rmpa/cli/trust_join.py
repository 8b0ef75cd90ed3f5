"""``rmpa trust invite`` and ``rmpa trust join``: a new module, by a token or by files."""

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

from rmpa.cli.module import check_library
from rmpa.cli.options import Options, argument, flag
from rmpa.cli.output import confirm, print_json, warn
from rmpa.cli.trust import date_of, grouped, keep_member_name, trust_verb
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError, StartError
from rmpa.core.identity import peer_name_problem
from rmpa.runtime.systemd import restart_text
from rmpa.trust import limits
from rmpa.trust.permissions import InviteReply, JoinStep, TrustError, TrustReply

if TYPE_CHECKING:
    from rmpa.cli.module import Module
    from rmpa.trust.store import MemberFiles

_LIFETIME: Final = re.compile(r"([0-9]{1,6})\s*(s|min|h|d)")
_UNITS: Final = {"s": 1, "min": 60, "h": 3600, "d": 86_400}
_FINGERPRINT: Final = 2 * limits.FINGERPRINT_BYTES


@trust_verb(
    click.option(
        "--for", "lifetime", metavar="TIME", default="15min", help="Validity: 90s, 15min, 2h, 3d. [default: 15min]"
    ),
    click.option(
        "--module",
        "invitee",
        metavar="MODULE",
        help="Only this module may use it; it may be one that joins again. [default: any]",
    ),
    click.option(
        "--address", metavar="HOST[:PORT]", help="Where the module reaches this one. [default: as other agents do]"
    ),
    flag("--yes", help="With --sign: do not ask."),
    flag("--no-wait", help="Print the token and end."),
    click.option("--sign", metavar="FILE", help="Answer the request of rmpa trust join --request; no token is made."),
    click.option("--out", metavar="FILE", help="Where --sign writes the answer, a secret. [default: FILE.answer]"),
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


@trust_verb(
    argument("token", required=False),
    click.option("--request", metavar="FILE", help="Join by files: write the request."),
    click.option("--accept", metavar="FILE", help="Join by files: read the answer."),
    click.option(
        "--ca",
        metavar="FINGERPRINT",
        help="With --accept: the fingerprint of the CA, as rmpa trust invite --sign shows it.",
    ),
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
