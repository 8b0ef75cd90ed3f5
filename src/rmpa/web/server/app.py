"""The routes of ``rmpa web``, and what holds for all of them: access, read-only, headers, counts.

A gateway or a page is added as one more route (``Routes.application``): the middleware judges its requests, WebSocket
upgrades included, before its handler runs.
"""

from __future__ import annotations

import asyncio
import html
import logging
import time
from dataclasses import dataclass
from importlib.resources import files
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Final

from aiohttp import web
from aiohttp.abc import AbstractAccessLogger

from rmpa.core.counters import Counters, RefusalLog
from rmpa.core.errors import StartError
from rmpa.web import api as rest
from rmpa.web import limits
from rmpa.web.api import content_type, make_metrics
from rmpa.web.gateways.gateways import MONITOR_PATH, is_upgrade
from rmpa.web.server.access import (
    TOKEN_PARAMETER,
    AccessPolicy,
    AccessRefused,
    ConnectionTable,
    Figures,
    GuardedConnection,
    MoveToken,
    Preflight,
    RequestFacts,
    host_name,
    is_loopback,
)

if TYPE_CHECKING:
    import ssl
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from importlib.abc import Traversable

    from aiohttp.typedefs import Handler, Middleware

    from rmpa.web.gateways.gateways import Gateways
    from rmpa.web.server.agent_watch import AgentWatch


# The committed files that the server gives: read once, served by their exact paths; all are in the wheel.


_TYPES: Final = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
_FIRST: Final = "index.html"
"""Is served at ``/``, all others below ``/static/``; files of other kinds, as licences, are not served."""


@dataclass(frozen=True, slots=True)
class Page:
    """One file, with its content type."""

    body: bytes
    content_type: str

    @property
    def is_html(self) -> bool:
        """Whether it is a page for people."""
        return self.content_type.startswith("text/html")


def read_pages() -> dict[str, Page]:
    """All files, by path."""
    return dict(_pages(files("rmpa.web") / "static", "/static/"))


def _pages(folder: Traversable, path: str) -> Iterator[tuple[str, Page]]:
    for each in folder.iterdir():
        content_type = _TYPES.get(PurePosixPath(each.name).suffix)
        if each.is_dir():
            yield from _pages(each, f"{path}{each.name}/")
        elif content_type is not None:
            yield "/" if each.name == _FIRST else f"{path}{each.name}", Page(each.read_bytes(), content_type)


_log = logging.getLogger(__name__)
_OPEN: Final = ("/healthz",)
"""Paths without a token: they tell only whether the agent answers."""
WEBSOCKET_PATHS: Final = ("/", "/rosbridge", "/foxglove", MONITOR_PATH)
"""Where WebSocket clients connect. The pages have their own path; else the subprotocol chooses the gateway."""
_METHODS: Final = ("GET", "HEAD")
_SHOWN: Final = 120
"""Characters of a faulty header that are told."""
_JUDGED: Final = web.RequestKey("rmpa.judged", bool)
"""Marks requests that reached the middleware; aiohttp answers malformed ones before."""
HEADERS: Final = {
    "Content-Security-Policy": "default-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'; object-src 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
    "Cache-Control": "no-store",
    "Server": "rmpa",
}
"""Of every response."""
OPENER_POLICY: Final = ("Cross-Origin-Opener-Policy", "same-origin")
"""Of responses to loopback: in plain HTTP browsers ignore it from elsewhere, and report that as an error."""
_REFUSED_PAGE: Final = """<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<meta name="color-scheme" content="light dark"><title>RMPA: refused</title>
<h1>RMPA does not show this page</h1><p>{text}.</p>{help}
"""
"""Without a style: the server's files need the token, too."""
_SIGN_IN: Final = (
    "<p>Open the address that <code>rmpa web</code> printed when it made the token, once: it ends with "
    "<code>/?token=…</code>, and this browser keeps it from then on. The token is in the file <code>web-token</code> "
    "of the module's state directory; <code>rmpa web</code> says at its start where that is.</p>"
)
PREFLIGHT: Final = {
    "Access-Control-Allow-Methods": ", ".join(_METHODS),
    "Access-Control-Allow-Headers": "Authorization",
    "Access-Control-Max-Age": "600",
}
"""Of the response to a browser's question what a page of a listed site may send (Fetch standard, "CORS protocol").
Cookies are not allowed: such a page sends the token itself."""


class Routes:
    """The handlers of all paths.

    Args:
        watch: Gives the agent's snapshot.
        policy: Says which requests are served.
        pages: Files by path.
        connections: Returns how many connections are open, and how many there were.
        counters: Refusals by reason, those of the connections too.
        gateways: Serve WebSocket upgrades of ``WEBSOCKET_PATHS``.
    """

    def __init__(
        self,
        watch: AgentWatch,
        policy: AccessPolicy,
        pages: Mapping[str, Page],
        connections: Callable[[], tuple[int, int]],
        counters: Counters,
        gateways: Gateways | None = None,
    ) -> None:
        self._watch = watch
        self._gateways = gateways
        self._policy = policy
        self._pages = pages
        self._connections = connections
        self._counters = counters
        self._refusals = RefusalLog(_log, counters)
        self.responses = Counters()
        """Responses by status."""
        if gateways is not None:
            gateways.upgraded = _upgraded
        self._encoding = asyncio.Lock()
        self._encoded: dict[str, tuple[int, bytes, str]] = {}

    def application(self) -> web.Application:
        """The application, to be run once."""
        app = web.Application(middlewares=[self._middleware()])
        for path in self._pages:
            app.router.add_get(path, self._page)
        app.router.add_get("/metrics", self._metrics)
        app.router.add_get("/healthz", self._health)
        app.router.add_get(rest.PREFIX + "/{below:.*}", self._api)
        return app

    # --- what holds for all paths ---

    def _middleware(self) -> Middleware:
        @web.middleware
        async def middleware(request: web.Request, handler: Handler) -> web.StreamResponse:
            request[_JUDGED] = True
            connection = _connection(request)
            if connection is not None:
                connection.request_begins()
            try:
                response = await self._respond(request, handler)
            finally:
                if connection is not None:
                    connection.request_ends()
            if not response.prepared:
                response.headers.update(HEADERS)
                response.headers.update(self._sharing(request))
                if is_loopback(host_name(request.host) or ""):
                    response.headers.update((OPENER_POLICY,))
            return response

        return middleware

    async def _respond(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        verdict = self._policy.judge(self._facts(request))
        if isinstance(verdict, AccessRefused):
            return self._refused(request, verdict.reason, rest.problem(verdict.status, verdict.detail))
        if request.method not in _METHODS and not isinstance(verdict, Preflight):
            text = f"{request.method[:20]} is not supported; this server only shows, and is read with GET"
            return self._refused(request, "method", rest.problem(405, text, (("Allow", ", ".join(_METHODS)),)))
        if request.body_exists:
            return self._refused(request, "body", rest.problem(413, "a request with a body; send none with GET"))
        if isinstance(verdict, Preflight):
            return web.Response(status=204, headers=PREFLIGHT)
        if isinstance(verdict, MoveToken):
            return self._move_token(request)
        if self._gateways is not None and is_upgrade(request) and request.path in WEBSOCKET_PATHS:
            return await self._upgrade(request, self._gateways)
        try:
            return await handler(request)
        except web.HTTPException:  # of aiohttp's router: no such path
            return _response(rest.problem(404, f"there is no {request.path[:80]!a}; / lists what there is"))
        except Exception:  # noqa: BLE001 - the top of the request: a fault in one path must not end the connection's task
            _log.exception("! %s failed", request.path)
            return _response(rest.problem(500, "the server failed; its log says why"))

    async def _upgrade(self, request: web.Request, gateways: Gateways) -> web.StreamResponse:
        """Serve a WebSocket until it has ended."""
        try:
            return await gateways.handle(request)
        except web.HTTPBadRequest as error:  # of aiohttp's handshake
            text = (error.text or "").partition("\n")[0][:_SHOWN]
            gateways.refuse(request.remote or "?", "handshake", text)
            return _response(rest.problem(400, f"not the handshake of a WebSocket: {text}"))
        except Exception:  # noqa: BLE001 - as above
            _log.exception("! the WebSocket at %s failed", request.path)
            return _response(rest.problem(500, "the server failed; its log says why"))

    def _facts(self, request: web.Request) -> RequestFacts:
        headers = request.headers
        page = None if is_upgrade(request) else self._pages.get(request.path)
        return RequestFacts(
            host=tuple(headers.getall("Host", ())),
            origin=headers.get("Origin"),
            fetch_site=headers.get("Sec-Fetch-Site"),
            fetch_mode=headers.get("Sec-Fetch-Mode"),
            authorization=headers.get("Authorization"),
            cookie=request.cookies.get(self._policy.cookie),
            token=request.query.get(TOKEN_PARAMETER),
            is_page=page is not None and page.is_html,
            is_open=request.path in _OPEN,
            is_preflight=request.method == "OPTIONS"
            and "Access-Control-Request-Method" in headers
            and request.path not in self._pages,
            secure=request.secure,
        )

    def _sharing(self, request: web.Request) -> dict[str, str]:
        """Headers that let pages of listed sites read a response; those of the pages' own files are not shared."""
        if not self._policy.origins or request.path in self._pages:
            return {}
        origin = request.headers.get("Origin")
        allowed = {"Access-Control-Allow-Origin": origin} if origin is not None and self._policy.lists(origin) else {}
        return {"Vary": "Origin", **allowed}

    def _refused(self, request: web.Request, reason: str, problem: rest.RestResponse) -> web.Response:
        address = request.remote or "?"
        self._refusals.refuse(time.monotonic(), reason, address, f"{address}: {rest.detail_of(problem)}")
        response = _page_of(problem) if _is_for_people(request) else _response(problem)
        if problem.status == 401:
            response.headers["WWW-Authenticate"] = 'Bearer realm="rmpa"'
        if request.body_exists:
            response.force_close()
        return response

    def _move_token(self, request: web.Request) -> web.Response:
        query = {name: value for name, value in request.query.items() if name != TOKEN_PARAMETER}
        response = web.Response(status=303, headers={"Location": str(request.rel_url.with_query(query))})
        token = request.query[TOKEN_PARAMETER]
        # Strict would leave the cookie out of the redirected request where the link stands on a page of another site,
        # and of each reload behind it. Lax sends it with such a navigation alone, which no other site can read.
        response.set_cookie(
            self._policy.cookie, token, httponly=True, secure=request.secure, samesite="Lax", path="/"
        )
        return response

    # --- the paths ---

    async def _page(self, request: web.Request) -> web.Response:
        page = self._pages[request.path]
        return web.Response(body=page.body, headers={"Content-Type": page.content_type})

    async def _health(self, _request: web.Request) -> web.Response:
        reading = await self._watch.reading()
        if reading.snapshot is None:
            return _response(rest.problem(503, "the agent does not answer"))
        return web.Response(text="ok\n")

    async def _api(self, request: web.Request) -> web.Response:
        reading = await self._watch.whole()
        return _response(rest.respond(request.rel_url.raw_path, reading.snapshot, reading.problem))

    async def _metrics(self, request: web.Request) -> web.Response:
        accept = request.headers.get("Accept", "")
        reading = await self._watch.reading()
        async with self._encoding:  # once for all
            form = content_type(accept)
            made = self._encoded.get(form)
            if made is None or made[0] != reading.number:
                body, kind = await make_metrics(reading.snapshot, accept, self._figures())
                made = (reading.number, body, kind)
                self._encoded = {key: each for key, each in self._encoded.items() if each[0] == reading.number}
                if len(self._encoded) < limits.METRIC_FORMATS:
                    self._encoded[form] = made
        return web.Response(body=made[1], headers={"Content-Type": made[2]})

    def _figures(self) -> Figures:
        connections, accepted = self._connections()
        return Figures(
            connections,
            accepted,
            self.responses.as_dict(),
            self._counters.as_dict() | (self._gateways.counters.as_dict() if self._gateways is not None else {}),
            self._watch.reads,
            self._watch.seconds,
            self._gateways.figures() if self._gateways is not None else {},
        )

    # --- what aiohttp answers by itself ---

    def access_logger(self) -> type[AbstractAccessLogger]:
        """The class that is told of every response, also of those to bytes that are no HTTP."""
        routes = self

        class CountingAccessLogger(AbstractAccessLogger):
            def log(self, request: web.BaseRequest, response: web.StreamResponse, time: float) -> None:  # noqa: ARG002
                routes.count(request, response.status)

        return CountingAccessLogger

    def count(self, request: web.BaseRequest, status: int) -> None:
        """Count a response."""
        self.responses.add(str(status))
        if _JUDGED not in request:
            address = request.remote or "?"
            text = f"{address}: a request that is no HTTP/1.1, or with a header beyond the limits (docs/limits.md)"
            self._refusals.refuse(time.monotonic(), "malformed", address, text)


def _connection(request: web.Request) -> GuardedConnection | None:
    transport = request.transport
    protocol = transport.get_protocol() if transport is not None else None
    return protocol if isinstance(protocol, GuardedConnection) else None


def _upgraded(request: web.Request, on_unmasked: Callable[[], None]) -> Callable[[], int]:
    """The limits of requests do not hold for the connection any more; returns what counts its bytes."""
    connection = _connection(request)
    if connection is None:
        return int
    connection.upgrade(on_unmasked)
    return lambda: connection.received


def _is_for_people(request: web.Request) -> bool:
    """Whether a browser shows the response: programs ask for no HTML."""
    return not is_upgrade(request) and "text/html" in request.headers.get("Accept", "")


def _page_of(problem: rest.RestResponse) -> web.Response:
    text = html.escape(rest.detail_of(problem))
    help_ = _SIGN_IN if problem.status == 401 else ""
    page = _REFUSED_PAGE.format(text=text[:1].upper() + text[1:], help=help_)
    headers = {"Content-Type": "text/html; charset=utf-8", **dict(problem.headers)}
    return web.Response(status=problem.status, body=page.encode(), headers=headers)


def _response(made: rest.RestResponse) -> web.Response:
    headers = {"Content-Type": made.content_type, **dict(made.headers)}
    return web.Response(status=made.status, body=made.body, headers=headers)


# Listens, and runs the application: the I/O of ``rmpa web``.


_AIOHTTP: Final = logging.getLogger("rmpa.web.server.aiohttp")
"""What aiohttp says of broken requests; they are counted and logged by us, without tracebacks."""
_AIOHTTP.setLevel(logging.CRITICAL)


class WebServer:
    """One server at one address.

    Args:
        watch: Gives the agent's snapshot; closed with the server.
        policy: Which requests are served.
        host: The address to listen at.
        gateways: Serve WebSocket clients.
        ports: Further ports to listen at.
        tls: Serves HTTPS with its certificate; ``None``: HTTP.
    """

    def __init__(
        self,
        watch: AgentWatch,
        policy: AccessPolicy,
        host: str,
        gateways: Gateways | None = None,
        ports: Sequence[int] = (),
        tls: ssl.SSLContext | None = None,
    ) -> None:
        self._tls = tls
        self._gateways = gateways
        self._ports = ports
        self._watch = watch
        self._host = host
        self._policy = policy
        self.counters = Counters()
        """Refusals, by reason."""
        self._table: ConnectionTable | None = None
        self._routes = Routes(
            watch,
            policy,
            read_pages(),
            self._connections,
            self.counters,
            gateways,
        )
        self._runner: web.AppRunner | None = None
        self._servers: list[asyncio.Server] = []

    async def start(self) -> None:
        """Listen.

        Raises:
            StartError: The address cannot be used.
        """
        runner = web.AppRunner(
            self._routes.application(),
            access_log_class=self._routes.access_logger(),
            access_log=_AIOHTTP,
            logger=_AIOHTTP,
            shutdown_timeout=limits.WEB_SHUTDOWN_TIMEOUT,
            keepalive_timeout=limits.WEB_IDLE_TIMEOUT,
            max_line_size=limits.WEB_LINE_MAX,
            max_field_size=limits.WEB_FIELD_MAX,
            max_headers=limits.WEB_HEADERS_MAX,
            lingering_time=limits.WEB_LINGER,
        )
        await runner.setup()
        make = runner.server
        assert make is not None, "setup() makes it"  # noqa: S101 - for the type checker
        self._table = ConnectionTable(make, self.counters)
        loop = asyncio.get_running_loop()
        for port in dict.fromkeys((self._policy.port, *self._ports)):
            try:
                server = await loop.create_server(
                    self._table.make,
                    self._host,
                    port,
                    backlog=limits.WEB_BACKLOG,
                    reuse_address=True,
                    ssl=self._tls,
                    ssl_handshake_timeout=limits.WEB_REQUEST_TIMEOUT if self._tls is not None else None,
                )
            except OSError as error:
                for server in self._servers:
                    server.close()
                self._servers.clear()
                await runner.cleanup()
                problem = f"cannot be listened at: {error.strerror or error}"
                remedy = "choose another --port or --listen" if port == self._policy.port else "see ports of [web]"
                raise StartError(f"{self._host}:{port}", problem, remedy) from None
            self._servers.append(server)
        self._runner = runner

    @property
    def port(self) -> int:
        """The port that it listens at."""
        if not self._servers:
            return self._policy.port
        port: int = self._servers[0].sockets[0].getsockname()[1]
        return port

    def _connections(self) -> tuple[int, int]:
        return (len(self._table), self._table.accepted) if self._table is not None else (0, 0)

    async def close(self) -> None:
        """End: responses under way have ``limits.WEB_SHUTDOWN_TIMEOUT``, then every connection is closed."""
        for server in self._servers:
            server.close()
        if self._gateways is not None:
            await self._gateways.close()
        if self._runner is not None:
            await self._runner.cleanup()
        if self._table is not None:
            self._table.abort_all()
        await self._watch.close()
