"""``rmpa web``: the web server of this machine's module."""

from __future__ import annotations

import asyncio
import logging
import os
import shutil
import sys
from dataclasses import replace
from importlib.util import find_spec
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

import click

from rmpa.cli.module import Module, agent_settings, check_web, find_module
from rmpa.cli.options import Options, agent_verb, config_option, flag, option
from rmpa.cli.output import Painted, begin_log
from rmpa.config.read import INSECURE
from rmpa.config.settings import Settings, WebSettings
from rmpa.config.values import HOST, BadValue
from rmpa.core.errors import ConfigError
from rmpa.trust.permissions import Permissions

if TYPE_CHECKING:
    from rmpa.web.server.process import TokenAccess, WebSetup

_log = logging.getLogger("rmpa.web")
_DEFAULTS: Final = WebSettings()


@agent_verb(
    option("--port", help=f"Port to listen at. [default: {_DEFAULTS.port}]", type=click.IntRange(1, 65535)),
    option(
        "--listen",
        "ADDRESS",
        f"Address to listen at; beyond this machine a token is needed. [default: {_DEFAULTS.listen}]",
    ),
    option(
        "--token-file",
        "FILE",
        "Ask clients for the token of this file; made if it is missing. [default: in the state directory]",
    ),
    option("--host hosts", "NAME", "A further name of this server in URLs; repeatable.", multiple=True),
    flag("--control", "Let clients publish, call and offer services, and set parameters; they then need the token."),
    option("--cert", "FILE", "HTTPS with this certificate (PEM). [default: the module's, if secured]"),
    option("--key", "FILE", "Its private key (PEM). [default: in the certificate's file]"),
    flag("--drive", "Let the joystick of its pages command a robot; they need the token."),
    config_option,
    flag("--insecure", "Start without an agent although other modules here have keys."),
    flag("--check", "Only check that it could start with these settings."),
)
def web(config: str | None, insecure: bool, check: bool, options: Options, **given: Any) -> int:
    """Show the mesh in a browser; serve rosbridge and Foxglove clients, /metrics for Prometheus, /api/v1 as JSON.

    It is a process of its own: the agent does not depend on it. It starts without an agent too, and finds it later.

    ---
    [web] of rmpa.toml and the variables RMPA_WEB_* set the same; options override them.
    It is as secure as the agent: if the module is in a secured mesh, it serves HTTPS with the module's certificate
    and by its [[permission]] rules. If the agent restarts as a member, it starts again too.

    Examples:
      rmpa web                        for this machine: http://127.0.0.1:8480/, https:// in a secured mesh
      rmpa web --listen 0.0.0.0       for the network; prints the URL with its token once, and as a QR code
      rmpa up --web                   the agent starts it, and again if it ends
      curl -s localhost:8480/api/v1/peers | jq '.[].name'
    """
    check_web()

    def make() -> tuple[Module, WebSetup]:
        module = find_module(options.agent, {"config": config}, os.environ, "--agent")
        settings = module.loaded.settings
        said = {name: value for name, value in given.items() if value not in (None, False, ())}
        if "listen" in said:
            said["listen"] = _host("--listen", said["listen"])
        said["hosts"] = (*settings.web.hosts, *(_host("--host", name) for name in given["hosts"]))
        settings = replace(settings, web=replace(settings.web, **said))
        if insecure:
            settings = replace(settings, trust=replace(settings.trust, insecure=True))
        return module, _setup(module, settings)

    module, setup = make()
    if check:
        options.show({}, "the settings can be used")
        return 0
    said = [f"--insecure: {INSECURE['trust.insecure']}"] if insecure else []
    begin_log(setup.settings, (*module.loaded.notes, *said), _log, sys.stderr)
    from rmpa.web.server.access import is_loopback
    from rmpa.web.server.process import serve

    def announce(url: str, access: TokenAccess) -> None:
        lines: list[str] = [url]
        if access.is_new:
            lines.append(f"the token is kept in {access.file}; it is not printed again")
        elif access.file:
            lines.append(f"clients need the token of {access.file}")
        if not (options.as_json or is_loopback(urlsplit(url).hostname or "")):
            lines += _qr_code(url)
        options.show({"url": url, "token_file": str(access.file or "")}, lines)
        sys.stdout.flush()

    while True:
        if setup.trusted and not Permissions(setup.settings.trust).knows("web"):
            _log.warning("! no [[permission]] lets web do anything: its clients see names alone [not-permitted]")
        pinned = module.name if module.chosen.source.said else None
        if not asyncio.run(serve(setup, pinned, announce, load=lambda: make()[1])):
            return 0
        module, setup = make()


def _qr_code(url: str) -> list[Painted]:
    """A URL for the camera of a phone, on a terminal that can show it: two rows of the code in one line."""
    plain = os.environ.get("TERM") == "dumb" or "utf" not in (sys.stdout.encoding or "").lower()
    if not sys.stdout.isatty() or plain or find_spec("segno") is None:
        return []
    import segno

    rows = [[bool(dark) for dark in row] for row in segno.make(url, error="l", micro=False).matrix_iter(border=2)]
    if len(rows[0]) > shutil.get_terminal_size().columns:
        return []
    pairs = zip_longest(rows[::2], rows[1::2], fillvalue=[False] * len(rows[0]))
    blocks = {(False, False): " ", (True, False): "▀", (False, True): "▄", (True, True): "█"}
    lines = ("".join(blocks[both] for both in zip(upper, lower, strict=True)) for upper, lower in pairs)
    # Dark on light, whatever the terminal's colours are: cameras want it so.
    return [Painted(f"\x1b[30;107m{line}\x1b[0m") for line in lines]


def _setup(module: Module, settings: Settings) -> WebSetup:
    """What the server of a module is made of; it is as secure as the module's agent.

    Raises:
        RmpaError: A file cannot be used; or no agent runs, the module has no keys, and others have some.
    """
    from rmpa.trust.store import check_open
    from rmpa.web.server.process import WebSetup, access_of, certificate_files, tls_context

    store = module.store if module.state is not None else None
    trusted = module.agent == "secured" or (store is not None and store.exists)
    if not trusted and module.socket is None:
        check_open(settings.trust, module.state, module.name, os.environ, "--agent")
    if trusted:
        settings = replace(settings, trust=agent_settings(module).settings.trust)
    files = certificate_files(settings.web.cert, settings.web.key, store if trusted else None)
    tls_context(files)  # a changed certificate that cannot be used must not end a server that runs
    access = access_of(settings.web, module.name, os.environ, settings.state_dir)
    folder = str(store.folder) if store is not None else ""
    return WebSetup(settings, access, files, trusted, module.name, folder)


def _host(option: str, text: str) -> str:
    try:
        return HOST.read(text)
    except BadValue as error:
        raise ConfigError(option, error.problem, error.remedy) from None
