"""Which requests are served: decisions over a request's headers; no I/O.

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

import hmac
import ipaddress
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterable

TOKEN_PARAMETER: Final = "token"  # noqa: S105 - its name, not its value
REASONS: Final = ("host", "origin", "token")
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
