"""Which requests are served: host, origin, token, connections, and the counts of refusals.

Which requests are served: decisions over a request's headers; no I/O.

Three checks, in this order:

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
import logging
import os
import re
import secrets
import stat
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, cast

from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, SummaryMetricFamily

from rmpa.core.counters import RefusalLog
from rmpa.core.errors import StartError
from rmpa.web import limits
from rmpa.web.gateways.frame_writer import MaskCheck
from rmpa.web.gateways.gateways import PROTOCOLS, GatewayFigures
from rmpa.web.gateways.gateways import REASONS as GATEWAY_REASONS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from pathlib import Path

    from prometheus_client.metrics_core import Metric

    from rmpa.core.counters import Counters

TOKEN_PARAMETER: Final = "token"  # noqa: S105 - its name, not its value
ACCESS_REASONS: Final = ("host", "origin", "token")
"""The values of ``AccessRefused.reason``."""
_HOST: Final = re.compile(r"(?:\[(?P<six>[0-9A-Fa-f:.]+)\]|(?P<name>[A-Za-z0-9_.-]+))(?::[0-9]{1,5})?")
_SHOWN: Final = 80


@dataclass(frozen=True, slots=True)
class RequestFacts:
    """What the decision is made of. ``None`` is a header that is missing.

    Attributes:
        host: All ``Host`` headers; HTTP/1.1 has exactly one.
        origin: ``Origin``.
        fetch_site: ``Sec-Fetch-Site``, which pages cannot set.
        fetch_mode: ``Sec-Fetch-Mode``.
        authorization: ``Authorization``.
        cookie: The value of the token's cookie.
        token: The query's ``token``.
        is_page: Whether the path is a page for people, for which a cookie is set.
        is_open: Whether the path needs no token.
        is_preflight: Whether a browser asks what a page of another site may send (Fetch standard, "CORS-preflight").
        secure: Whether it came by HTTPS.
    """

    host: tuple[str, ...]
    origin: str | None = None
    fetch_site: str | None = None
    fetch_mode: str | None = None
    authorization: str | None = None
    cookie: str | None = None
    token: str | None = None
    is_page: bool = False
    is_open: bool = False
    is_preflight: bool = False
    secure: bool = False


@dataclass(frozen=True, slots=True)
class AccessGranted:
    """The request is served."""


@dataclass(frozen=True, slots=True)
class MoveToken:
    """The page is served at the same URL without its token, which becomes a cookie."""


@dataclass(frozen=True, slots=True)
class Preflight:
    """The browser is told what pages of a listed site may send."""


@dataclass(frozen=True, slots=True)
class AccessRefused:
    """The request is not served.

    Attributes:
        reason: One of ``REASONS``, for the counter.
        status: The HTTP status.
        detail: What happened and what to do.
    """

    reason: str
    status: int
    detail: str


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

    def judge(self, request: RequestFacts) -> AccessGranted | MoveToken | Preflight | AccessRefused:
        """The decision about a request."""
        refused = self._wrong_host(request) or self._wrong_origin(request)
        if refused is not None:
            return refused
        if request.is_preflight and self.lists(request.origin):
            return Preflight()
        return self._by_token(request)

    def lists(self, origin: str | None) -> bool:
        """Whether an ``Origin`` is one of ``origins``; ``*`` never is."""
        return origin is not None and origin != "*" and origin.lower() in self.origins

    def _wrong_host(self, request: RequestFacts) -> AccessRefused | None:
        if len(request.host) != 1:
            return AccessRefused("host", 400, f"the request has {len(request.host)} Host headers; send exactly one")
        host = request.host[0]
        name = host_name(host)
        if name is not None and (is_address(name) or name in self.hosts):
            return None
        remedy = "use its address, or add the name with --host (hosts of [web] in rmpa.toml)"
        return AccessRefused("host", 403, f"{_short(host)} is no name of this server; {remedy}")

    def _wrong_origin(self, request: RequestFacts) -> AccessRefused | None:
        if request.origin is not None:
            scheme, _, rest = request.origin.partition("://")
            # A page of plain HTTP may be forged on its way, so it is no page of a server of HTTPS. A server of plain
            # HTTP may be behind a proxy that ends TLS: its own pages are then of HTTPS.
            schemes = ("https",) if request.secure else ("http", "https")
            if scheme in schemes and rest.lower() == request.host[0].lower():
                return None
            if self.lists(request.origin):
                return None
            return _foreign(_short(request.origin))
        elsewhere = request.fetch_site in ("cross-site", "same-site")
        # A link on another page may lead here: the browser shows the page, and the other page cannot read it.
        if elsewhere and not (request.fetch_mode == "navigate" and request.is_page):
            return _foreign("another site")
        return None

    def _by_token(self, request: RequestFacts) -> AccessGranted | MoveToken | AccessRefused:
        if not self.token or request.is_open:
            return AccessGranted()
        if self._fits(request.token):
            return MoveToken() if request.is_page else AccessGranted()
        given = [bearer(request.authorization), request.cookie]
        if any(map(self._fits, given)):
            return AccessGranted()
        remedy = (
            "send it as Authorization: Bearer TOKEN or as ?token=TOKEN; rmpa web says at its start where the token is"
        )
        if request.token is None and not any(each is not None for each in given):
            return AccessRefused("token", 401, f"this server needs a token; {remedy}")
        return AccessRefused("token", 401, f"the token is wrong; {remedy}")

    def _fits(self, token: str | None) -> bool:
        return token is not None and hmac.compare_digest(token.encode("utf-8", "replace"), self.token.encode())


def _foreign(whose: str) -> AccessRefused:
    return AccessRefused(
        "origin",
        403,
        f"pages of {whose} may not read from this server; open its own pages instead, or list it as origins of [web]",
    )


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


# The file of the token that clients need: made once, readable by its owner alone.


_TOKEN: Final = re.compile(r"[A-Za-z0-9._~+/=-]+")  # RFC 6750, section 2.1


def token_from(path: Path) -> tuple[str, bool]:
    """The token of a file, and whether the file was made now.

    Raises:
        StartError: The file cannot be made or read, others may read it, or it holds no token.
    """
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        try:
            fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        except FileExistsError:
            return _read(path), False
        token = secrets.token_urlsafe(limits.WEB_TOKEN_BYTES)
        with os.fdopen(fd, "w", encoding="ascii") as file:
            file.write(f"{token}\n")
    except OSError as error:
        problem = f"the token's file cannot be used: {error.strerror}"
        raise StartError(str(path), problem, "choose another one with --token-file") from None
    return token, True


def _read(path: Path) -> str:
    with path.open("rb") as file:
        mode = os.fstat(file.fileno()).st_mode
        if stat.S_ISREG(mode) and mode & 0o077:
            problem = f"other users may use the token's file (mode {stat.S_IMODE(mode):03o})"
            raise StartError(str(path), problem, f"chmod 600 {path}")
        text = file.read(limits.WEB_TOKEN_FILE_MAX).decode("utf-8", "replace").strip()
    if len(text) < limits.WEB_TOKEN_LENGTH_MIN or not _TOKEN.fullmatch(text):
        problem = f"holds no token of {limits.WEB_TOKEN_LENGTH_MIN} letters, digits or ._~+/=- and more"
        raise StartError(str(path), problem, "remove the file, and rmpa web makes one")
    return text


# Limits of connections that aiohttp has not: their number, the time of a request and of a response, bytes in a row.
#
# Each connection has a ``GuardedConnection`` between its transport and aiohttp's protocol. Where there is no room
# for
# a new connection, the one that has gone without a request for longest is closed: connections that send nothing, or
# one byte a second, keep no others out.


_log = logging.getLogger(__name__)
CONNECTION_REASONS: Final = ("connections", "slow_request", "slow_response", "oversized")
"""Why connections are closed, as counted."""


class ConnectionTable:
    """All connections of one server.

    Args:
        make_protocol: Makes aiohttp's protocol of a new connection.
        counters: Counts what is closed, by the words of ``REASONS``.
    """

    def __init__(self, make_protocol: Callable[[], asyncio.Protocol], counters: Counters) -> None:
        self._make_protocol = make_protocol
        self._refusals = RefusalLog(_log, counters)
        self._open: dict[GuardedConnection, None] = {}
        self.accepted = 0
        """Connections so far."""

    def __len__(self) -> int:
        return len(self._open)

    def make(self) -> GuardedConnection:
        """The protocol of a new connection, for ``loop.create_server``."""
        return GuardedConnection(self, self._make_protocol())

    def opened(self, connection: GuardedConnection) -> bool:
        """Take a connection in; return whether there is room."""
        self.accepted += 1
        if len(self._open) >= limits.WEB_CONNECTIONS_MAX:
            idle = next((each for each in self._open if not each.is_answering), connection)
            idle.refuse("connections", f"{limits.WEB_CONNECTIONS_MAX} connections are open; the idlest is closed")
            if idle is connection:
                return False
        self._open[connection] = None
        return True

    def used(self, connection: GuardedConnection) -> None:
        """Note that a connection got a request: others are idler."""
        if connection in self._open:
            del self._open[connection]
            self._open[connection] = None

    def closed(self, connection: GuardedConnection) -> None:
        """Forget a connection."""
        self._open.pop(connection, None)

    def refuse(self, now: float, reason: str, address: str, text: str) -> None:
        """Count and log a connection that is closed."""
        self._refusals.refuse(now, reason, address, f"{address}: {text}")

    def abort_all(self) -> None:
        """Close every connection at once."""
        for connection in list(self._open):
            connection.abort()


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
        self._received = 0
        self._arriving = False
        self._unread = False
        self._upgraded = False
        self._mask: MaskCheck | None = None
        self._on_unmasked: Callable[[], None] | None = None
        self.received = 0
        """Bytes of the client so far."""
        self.is_answering = False
        """Whether a response is being made."""

    # --- what aiohttp's handlers tell ---

    def request_begins(self) -> None:
        """A request has arrived; its response is being made."""
        self.is_answering, self._arriving = True, False
        self._table.used(self)
        self._limit(limits.WEB_RESPONSE_TIMEOUT, "slow_response", "the response takes too long")

    def request_ends(self) -> None:
        """The response is made; the client has some time to read it and to send the next request."""
        self.is_answering, self._received = False, 0
        if not self._upgraded:
            self._limit(limits.WEB_IDLE_TIMEOUT, None, "")

    def upgrade(self, on_unmasked: Callable[[], None]) -> None:
        """The connection is a WebSocket from now on, whose handler has limits of its own.

        Args:
            on_unmasked: Called when a frame of the client is not masked; it and all after it is dropped.
        """
        self._upgraded = True
        self._mask, self._on_unmasked = MaskCheck(), on_unmasked
        self._stop_timer()

    # --- the transport ---

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Pass the transport on, if there is room."""
        self._transport = cast("asyncio.Transport", transport)
        self._inner.connection_made(transport)
        if self._table.opened(self):
            self._await_request()

    def data_received(self, data: bytes) -> None:
        """Pass bytes on, as many as one request may have."""
        self.received += len(data)
        if self._on_unmasked is not None and (self._mask is None or not self._mask.passes(data)):
            if self._mask is not None:
                self._mask = None
                self._on_unmasked()
            return
        if not self._upgraded:
            self._received += len(data)
            if self._received > limits.WEB_REQUEST_MAX:
                self.refuse("oversized", f"it sent more than {limits.WEB_REQUEST_MAX} bytes at once")
                return
            if not (self._arriving or self.is_answering or self._unread):
                self._await_request()
        self._inner.data_received(data)

    def eof_received(self) -> bool | None:
        """Pass the end of the client's bytes on."""
        return self._inner.eof_received()

    def pause_writing(self) -> None:
        """Pass on that the client reads too slowly; it has some time to go on."""
        self._unread = True
        if not self._upgraded:
            self._limit(limits.WEB_RESPONSE_TIMEOUT, "slow_response", "it does not read the response")
        self._inner.pause_writing()

    def resume_writing(self) -> None:
        """Pass on that it reads again."""
        self._unread = False
        if not self._upgraded:
            self._limit(limits.WEB_IDLE_TIMEOUT, None, "")
        self._inner.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self._stop_timer()
        self._table.closed(self)
        self._inner.connection_lost(exc)

    # --- limits ---

    def refuse(self, reason: str, text: str) -> None:
        """Close the connection for one of ``REASONS``."""
        peer = self._transport.get_extra_info("peername") if self._transport is not None else None
        self._table.refuse(self._loop.time(), reason, str(peer[0]) if peer else "?", text)
        self.abort()

    def abort(self) -> None:
        """Close the connection; what waits to be sent is dropped."""
        self._stop_timer()
        self._table.closed(self)
        if self._transport is not None:
            self._transport.abort()

    def _await_request(self) -> None:
        self._arriving = True
        seconds = limits.WEB_REQUEST_TIMEOUT
        self._limit(seconds, "slow_request", f"no complete request came within {seconds:g} s")

    def _limit(self, seconds: float, reason: str | None, text: str) -> None:
        self._stop_timer()
        if self._transport is not None and not self._transport.is_closing():
            self._timer = self._loop.call_later(seconds, self._too_slow, reason, text)

    def _too_slow(self, reason: str | None, text: str) -> None:
        if reason is None:
            self.abort()
        else:
            self.refuse(reason, text)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


# The server's own figures, for ``/metrics``; no I/O.


REASONS: Final = (
    *ACCESS_REASONS,
    "method",
    "body",
    "malformed",
    "connections",
    "slow_request",
    "slow_response",
    "oversized",
    *GATEWAY_REASONS,
)
"""Why requests, connections and clients are refused; all are shown from 0 on, so that an alarm sees the first."""


@dataclass(frozen=True, slots=True)
class Figures:
    """What the server counts.

    Attributes:
        connections: Open at present.
        accepted: Connections so far.
        responses: Responses so far, by HTTP status.
        refused: Refusals so far, by the words of ``REASONS``.
        reads: Questions to the agent so far.
        read_seconds: Seconds that they took.
        gateways: What each gateway counts, by its protocol.
    """

    connections: int
    accepted: int
    responses: Mapping[str, int]
    refused: Mapping[str, int]
    reads: int
    read_seconds: float
    gateways: Mapping[str, GatewayFigures] = field(default_factory=dict)


def web_metrics(figures: Figures) -> Iterator[Metric]:
    """All metrics of the server."""
    yield GaugeMetricFamily("rmpa_web_connections", "Open connections of clients.", figures.connections)
    yield CounterMetricFamily("rmpa_web_accepted_connections", "Connections of clients so far.", figures.accepted)
    responses = CounterMetricFamily("rmpa_web_responses", "Responses by HTTP status.", labels=("status",))
    for status, count in sorted(figures.responses.items()):
        responses.add_metric((status,), count)
    yield responses
    refused = CounterMetricFamily(
        "rmpa_web_refused", "Requests, connections and WebSocket clients refused, by reason.", labels=("reason",)
    )
    for reason in REASONS:
        refused.add_metric((reason,), figures.refused.get(reason, 0))
    yield refused
    yield SummaryMetricFamily(
        "rmpa_web_agent_read_seconds", "Time to read the agent's snapshot.", figures.reads, figures.read_seconds
    )
    yield from _gateway_metrics(figures)


def _gateway_metrics(figures: Figures) -> Iterator[Metric]:
    labels = ("protocol",)
    clients = GaugeMetricFamily("rmpa_web_clients", "WebSocket clients of the gateways.", labels=labels)
    queued = GaugeMetricFamily("rmpa_web_client_queue_bytes", "Bytes that wait for these.", labels=labels)
    sent = CounterMetricFamily("rmpa_web_client_frames", "Messages and answers sent to these.", labels=labels)
    dropped = CounterMetricFamily(
        "rmpa_web_client_dropped_messages", "Messages dropped because one of these was slow.", labels=labels
    )
    for protocol in PROTOCOLS:
        gateway = figures.gateways.get(protocol, GatewayFigures())
        clients.add_metric((protocol,), gateway.clients)
        queued.add_metric((protocol,), gateway.queued)
        sent.add_metric((protocol,), gateway.sent)
        dropped.add_metric((protocol,), gateway.dropped)
    yield from (clients, queued, sent, dropped)
