"""Which requests and connections are served: host, origin, token, and limits of connections that aiohttp has not.

A request is judged by its headers, in this order:

* ``Host`` is an address or one of the server's names. A page of another site that lets its own name point to this
  machine (DNS rebinding) sends its own name here.
* ``Origin``, where the browser sends one, is this server or a listed site; ``Sec-Fetch-Site`` says the same of
  requests without one. A browser asks before it sends a listed site's token (CORS preflight): that has no token yet.
* The token, where there is one: ``Authorization: Bearer`` (programs), a cookie
  (browsers), or ``?token=`` (clients that know only a URL). A page's ``?token=`` is moved into the cookie by a
  redirect, so that it leaves the address bar and the history. The cookie's name has the port, since browsers share
  cookies between the ports of a host.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import os
import re
import secrets
import stat
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Final, Literal, TypeAlias, cast

import msgspec

from rmpa.core.errors import StartError
from rmpa.web import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from aiohttp import web

    from rmpa.core.log import RefusalLog

TOKEN_PARAMETER: Final = "token"  # noqa: S105 - its name, not its value
_HOST: Final = re.compile(r"(?:\[(?P<six>[0-9A-Fa-f:.]+)\]|(?P<name>[A-Za-z0-9_.-]+))(?::[0-9]{1,5})?")
_SHOWN: Final = 80

_TITLES: Final = {
    400: "Bad request",
    401: "A token is needed",
    403: "Refused",
    404: "Not found",
    405: "Method not allowed",
    413: "Too large",
    415: "Not an image",
    429: "Too many at one time",
    500: "Internal error",
    502: "Not made",
    503: "The agent does not answer",
    504: "No picture",
}


class Problem(Exception):  # noqa: N818 - the word of RFC 9457
    """Why a request has no result (RFC 9457).

    Args:
        status: The HTTP status.
        detail: What happened, and what to do.
        reason: One of ``api.REFUSALS``, by which it is counted and logged; empty: it is neither.
    """

    def __init__(self, status: int, detail: str, reason: str = "") -> None:
        super().__init__(detail)
        self.status, self.detail, self.reason = status, detail, reason

    @property
    def body(self) -> bytes:
        """Its problem details, of the type ``application/problem+json``."""
        return msgspec.json.encode({"title": _TITLES[self.status], "status": self.status, "detail": self.detail})


# What stands at a path: ``page``: for people, and a cookie is set for it; ``open``: it needs no token; ``pictures``,
# which other sites' pages show by ``<img>``; or anything else.
Place: TypeAlias = Literal["page", "open", "pictures", ""]
# ``move token``: the page is served at the same URL without its token, which becomes a cookie. ``preflight``: the
# browser is told what pages of a listed site may send.
Verdict: TypeAlias = Literal["granted", "move token", "preflight"]


@dataclass(frozen=True, slots=True)
class AccessPolicy:
    """What the server serves to which requests.

    Attributes:
        port: The server's port.
        hosts: The names under which it may be asked, in lower case; addresses are always accepted.
        token: Empty: none is needed.
        origins: Other sites whose pages may connect, as ``Origin`` headers name them, in lower case.
    """

    port: int
    hosts: frozenset[str]
    token: str = field(default="", repr=False)
    origins: frozenset[str] = frozenset()

    @property
    def cookie(self) -> str:
        """The name of the token's cookie."""
        return f"rmpa_token_{self.port}"

    def judge(self, request: web.BaseRequest, place: Place = "", *, shared: bool = True) -> Verdict:
        """The decision about a request.

        Args:
            request: The request.
            place: What it asks for.
            shared: Whether pages of listed sites may read that.

        Raises:
            Problem: It is not served, for its ``host``, ``origin`` or ``token``.
        """
        self._check_host(request)
        self._check_origin(request, place)
        is_preflight = request.method == "OPTIONS" and "Access-Control-Request-Method" in request.headers
        if is_preflight and shared and self.lists(request.headers.get("Origin")):
            return "preflight"
        return self._by_token(request, place)

    def lists(self, origin: str | None) -> bool:
        """Whether an ``Origin`` is one of ``origins``; ``*`` never is."""
        return origin is not None and origin != "*" and origin.lower() in self.origins

    def _check_host(self, request: web.BaseRequest) -> None:
        hosts = request.headers.getall("Host", ())
        if len(hosts) != 1:
            raise Problem(400, f"the request has {len(hosts)} Host headers; send exactly one", "host")
        name = host_name(hosts[0])
        if name is None or not (is_address(name) or name in self.hosts):
            remedy = "use its address, or add the name with --host (hosts of [web] in rmpa.toml)"
            raise Problem(403, f"{_short(hosts[0])} is no name of this server; {remedy}", "host")

    def _check_origin(self, request: web.BaseRequest, place: Place) -> None:
        headers = request.headers
        origin = headers.get("Origin")
        if origin is not None:
            scheme, _, rest = origin.partition("://")
            # A page of plain HTTP may be forged on its way, so it is no page of a server of HTTPS. A server of plain
            # HTTP may be behind a proxy that ends TLS: its own pages are then of HTTPS.
            schemes = ("https",) if request.secure else ("http", "https")
            if not ((scheme in schemes and rest.lower() == headers["Host"].lower()) or self.lists(origin)):
                raise _foreign(_short(origin))
            return
        # Only the token in the URL counts: a browser sends a cookie with requests of any site.
        if place == "pictures" and self.token and self._fits(request.query.get(TOKEN_PARAMETER)):
            return
        # A link on another page may lead here: the browser shows the page, and the other page cannot read it.
        leads = place == "page" and headers.get("Sec-Fetch-Mode") == "navigate"
        if headers.get("Sec-Fetch-Site") in ("cross-site", "same-site") and not leads:
            raise _foreign("another site")

    def _by_token(self, request: web.BaseRequest, place: Place) -> Verdict:
        if not self.token or place == "open":
            return "granted"
        asked = request.query.get(TOKEN_PARAMETER)
        if self._fits(asked):
            return "move token" if place == "page" else "granted"
        given = (bearer(request.headers.get("Authorization")), request.cookies.get(self.cookie))
        if any(map(self._fits, given)):
            return "granted"
        is_given = any(each is not None for each in (asked, *given))
        problem = "the token is wrong" if is_given else "this server needs a token"
        remedy = "send it as Authorization: Bearer TOKEN or as ?token=TOKEN"
        raise Problem(401, f"{problem}; {remedy}; rmpa web says at its start where the token is", "token")

    def _fits(self, token: str | None) -> bool:
        return token is not None and hmac.compare_digest(token.encode("utf-8", "replace"), self.token.encode())


def _foreign(whose: str) -> Problem:
    remedy = "open its own pages instead, or list it as origins of [web]"
    return Problem(403, f"pages of {whose} may not read from this server; {remedy}", "origin")


def bearer(authorization: str | None) -> str | None:
    """The token of an ``Authorization`` header; ``None`` where it is missing or of another scheme."""
    scheme, _, token = (authorization or "").partition(" ")
    return token.strip() if scheme.lower() == "bearer" and token.strip() else None


def host_name(host: str) -> str | None:
    """The name or address of a ``Host`` header, in lower case, without port and final dot; ``None`` if it is none."""
    match = _HOST.fullmatch(host)
    if match is None:
        return None
    return match["six"] or match["name"].lower().removesuffix(".")


def is_address(name: str) -> bool:
    """Whether a host is an IP address as it is written in URLs."""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches what listens at a host."""
    if host.lower() == "localhost":
        return True
    return is_address(host) and ipaddress.ip_address(host).is_loopback


def own_names(host_names: Iterable[str]) -> frozenset[str]:
    """The names under which a server may be asked: ``localhost``, and each host name, with ``.local`` (mDNS) too."""
    names = {name.lower().removesuffix(".") for name in host_names if name}
    return frozenset({"localhost", *names, *(f"{name}.local" for name in names if "." not in name)})


def _short(text: str) -> str:
    return ascii(text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…")


_TOKEN: Final = re.compile(r"[A-Za-z0-9._~+/=-]+")  # RFC 6750, section 2.1


def token_from(path: Path) -> tuple[str, bool]:
    """The token of a file, and whether the file was made now: readable by its owner alone.

    Raises:
        StartError: The file cannot be made or read, others may read it, or it holds no token.
    """
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        try:
            fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        except FileExistsError:
            return _read(path), False
        token = secrets.token_urlsafe(32)  # 256 bits cannot be guessed
        with os.fdopen(fd, "w", encoding="ascii") as file:
            file.write(f"{token}\n")
    except OSError as error:
        problem, remedy = f"the token's file cannot be used: {error.strerror}", "choose another one with --token-file"
        raise StartError(str(path), problem, remedy, code="directory-unusable") from None
    return token, True


def _read(path: Path) -> str:
    with path.open("rb") as file:
        info = os.fstat(file.fileno())
        mode = info.st_mode
        if stat.S_ISREG(mode) and info.st_uid not in (0, os.geteuid()) and os.geteuid():
            problem = f"the token's file belongs to user {info.st_uid}, who knows the token"
            raise StartError(str(path), problem, f"chown {os.geteuid()} {path}", code="directory-unusable")
        if stat.S_ISREG(mode) and mode & 0o077:
            problem = f"other users may use the token's file (mode {stat.S_IMODE(mode):03o})"
            raise StartError(str(path), problem, f"chmod 600 {path}", code="directory-unusable")
        text = file.read(limits.WEB_TOKEN_FILE_MAX).decode("utf-8", "replace").strip()
    if len(text) < limits.WEB_TOKEN_LENGTH_MIN or not _TOKEN.fullmatch(text):
        problem = f"holds no token of {limits.WEB_TOKEN_LENGTH_MIN} letters, digits or ._~+/=- and more"
        raise StartError(str(path), problem, "remove the file, and rmpa web makes one", code="directory-unusable")
    return text


class ConnectionTable:
    """All connections of one server.

    Each has a ``GuardedConnection`` between its transport and aiohttp's protocol. Where there is no room for a new
    one, the one that has gone without a request for longest is closed: connections that send nothing, or one byte a
    second, keep no others out.

    Args:
        make_protocol: Makes aiohttp's protocol of a new connection.
        refusals: Counts and tells what is closed, by its reason (``api.REFUSALS``).
    """

    def __init__(self, make_protocol: Callable[[], asyncio.Protocol], refusals: RefusalLog) -> None:
        self._make_protocol = make_protocol
        self.refusals = refusals
        # The connections, the idlest first.
        self.open: dict[GuardedConnection, None] = {}
        # Connections so far.
        self.accepted = 0

    def make(self) -> GuardedConnection:
        """The protocol of a new connection, for ``loop.create_server``."""
        return GuardedConnection(self, self._make_protocol())

    def opened(self, connection: GuardedConnection) -> bool:
        """Take a connection in; return whether there is room."""
        self.accepted += 1
        if len(self.open) >= limits.WEB_CONNECTIONS_MAX:
            at_work = ConnectionPhase.ANSWERING, ConnectionPhase.UPGRADED
            idle = next((each for each in self.open if each.phase not in at_work), connection)
            idle.refuse("connections", f"{limits.WEB_CONNECTIONS_MAX} connections are open; the idlest is closed")
            if idle is connection:
                return False
        self.open[connection] = None
        return True

    def abort_all(self) -> None:
        """Close every connection at once."""
        for connection in list(self.open):
            connection.abort()


# Bits of the first byte of a frame, and of the second one.
_LAST, _CONTROL = 0x80, 0x08
_MASKED: Final = 0x80
_MASK_BYTES: Final = 4


class FrameCheck:
    """Follows the frames of a client: the library takes some without a mask, and does not tell of half a message.

    A message may come in fragments, and control frames between them (RFC 6455, sections 5.1 and 5.4).
    """

    def __init__(self) -> None:
        self._header = bytearray()
        # Bytes of the frame's payload that are still to come, its mask included.
        self._payload = 0
        # Whether a message ends with the frame.
        self._ends = False
        # Since when a message has been arriving; ``None``: none is.
        self.since: float | None = None

    def passes(self, data: bytes, now: float) -> bool:
        """Take the next bytes of the connection; return whether all frames that begin in them are masked."""
        at = 0
        while at < len(data):
            if self._payload:
                taken = min(self._payload, len(data) - at)
                self._payload -= taken
                at += taken
                if not self._payload and self._ends:
                    self.since = None
                continue
            self._header.append(data[at])
            at += 1
            if len(self._header) == 1:
                self._ends = self._header[0] & (_LAST | _CONTROL) == _LAST
                if self.since is None and not self._header[0] & _CONTROL:
                    self.since = now
            length = self._header[1] & ~_MASKED if len(self._header) > 1 else 0
            if len(self._header) == 2 and not self._header[1] & _MASKED:
                return False
            extra = {126: 2, 127: 8}.get(length, 0)
            if len(self._header) == 2 + extra:
                self._payload = _MASK_BYTES + (int.from_bytes(self._header[2:], "big") if extra else length)
                self._header.clear()
        return True


class ConnectionPhase(Enum):
    """What a connection waits for."""

    IDLE = "the next request"
    ARRIVING = "the rest of a request"
    ANSWERING = "the response of a handler"
    UNREAD = "the client to read"
    UPGRADED = "a WebSocket or a stream, whose handler has limits of its own"


class GuardedConnection(asyncio.Protocol):
    """One connection, between its transport and aiohttp's protocol.

    Args:
        table: The server's.
        inner: aiohttp's protocol.
    """

    def __init__(self, table: ConnectionTable, inner: asyncio.Protocol) -> None:
        self._table = table
        self._inner = inner
        self._loop = asyncio.get_running_loop()
        self._transport: asyncio.Transport | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._since_response = 0
        self._on_unmasked: Callable[[], None] | None = None
        self._on_lost: Callable[[], None] = lambda: None
        self.phase = ConnectionPhase.IDLE
        # Of a WebSocket.
        self.frames = FrameCheck()
        # Bytes of the client so far.
        self.received = 0

    def request_begins(self) -> None:
        """A request has arrived; its response is being made. Other connections are idler now."""
        if self in self._table.open:
            del self._table.open[self]
            self._table.open[self] = None
        self._enter(ConnectionPhase.ANSWERING)

    def request_ends(self) -> None:
        """The response is made; the client has some time to read it and to send the next request."""
        self._since_response = 0
        self._enter(ConnectionPhase.IDLE)

    def upgrade(self, on_unmasked: Callable[[], None]) -> None:
        """The connection is a WebSocket from now on: the limits of requests do not hold any more.

        Args:
            on_unmasked: Called when a frame of the client is not masked; it and all after it is dropped.
        """
        self._on_unmasked = on_unmasked
        self._enter(ConnectionPhase.UPGRADED)

    def stream(self, on_lost: Callable[[], None]) -> None:
        """The response goes on for as long as the client reads it: the limits of requests do not hold any more.

        Args:
            on_lost: Called when the connection has ended.
        """
        self._on_lost = on_lost
        self._enter(ConnectionPhase.UPGRADED)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Pass the transport on, if there is room."""
        self._transport = cast("asyncio.Transport", transport)
        self._inner.connection_made(transport)
        if self._table.opened(self):
            self._enter(ConnectionPhase.ARRIVING)

    def data_received(self, data: bytes) -> None:
        """Pass bytes on, as many as one request may have."""
        self.received += len(data)
        if self.phase is ConnectionPhase.UPGRADED:
            if self._on_unmasked is None:
                return
            if not self.frames.passes(data, self._loop.time()):
                self._on_unmasked()
                self._on_unmasked = None
                return
        else:
            self._since_response += len(data)
            if self._since_response > limits.WEB_REQUEST_MAX:
                self.refuse("oversized", f"it sent more than {limits.WEB_REQUEST_MAX} bytes at once")
                return
            if self.phase is ConnectionPhase.IDLE:
                self._enter(ConnectionPhase.ARRIVING)
        self._inner.data_received(data)

    def eof_received(self) -> bool | None:
        """Pass the end of the client's bytes on."""
        return self._inner.eof_received()

    def pause_writing(self) -> None:
        """Pass on that the client reads too slowly; it has some time to go on."""
        self._enter(ConnectionPhase.UNREAD)
        self._inner.pause_writing()

    def resume_writing(self) -> None:
        """Pass on that it reads again."""
        self._enter(ConnectionPhase.IDLE)
        self._inner.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self._forget()
        self._inner.connection_lost(exc)
        self._on_lost()

    def refuse(self, reason: str, text: str) -> None:
        """Close the connection, counted by its reason."""
        peer = self._transport.get_extra_info("peername") if self._transport is not None else None
        address = str(peer[0]) if peer else "?"
        self._table.refusals.refuse(self._loop.time(), reason, address, f"{address}: {text}")
        self.abort()

    def abort(self) -> None:
        """Close the connection; what waits to be sent is dropped."""
        self._forget()
        if self._transport is not None:
            self._transport.abort()

    def _forget(self) -> None:
        self._table.open.pop(self, None)
        if self._timer is not None:
            self._timer.cancel()

    def _enter(self, phase: ConnectionPhase) -> None:
        """Begin to wait, for as long as the phase may take."""
        if self.phase is ConnectionPhase.UPGRADED:
            return
        self.phase = phase
        if self._timer is not None:
            self._timer.cancel()
        if self._transport is None or self._transport.is_closing():
            return
        request, response = limits.WEB_REQUEST_TIMEOUT, limits.WEB_RESPONSE_TIMEOUT
        late = self._loop.call_later
        if phase is ConnectionPhase.ARRIVING:
            self._timer = late(request, self.refuse, "slow_request", f"no complete request came within {request:g} s")
        elif phase is ConnectionPhase.ANSWERING:
            self._timer = late(response, self.refuse, "slow_response", "the response takes too long")
        elif phase is ConnectionPhase.UNREAD:
            self._timer = late(response, self.refuse, "slow_response", "it does not read the response")
        elif phase is ConnectionPhase.IDLE:
            self._timer = late(limits.WEB_IDLE_TIMEOUT, self.abort)


def guard_of(request: web.BaseRequest) -> GuardedConnection | None:
    """What guards the connection of a request; ``None``: nothing does."""
    protocol = request.transport.get_protocol() if request.transport is not None else None
    return protocol if isinstance(protocol, GuardedConnection) else None
