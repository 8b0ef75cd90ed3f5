"""``rmpa web``: this module's state for browsers and programs, over HTTP."""

from __future__ import annotations

import asyncio
import importlib.util
import logging
import os
import socket
import sys
from dataclasses import replace
from typing import TYPE_CHECKING

import click

from rmpa.cli.module import find_module
from rmpa.cli.options import agent_option, json_option
from rmpa.config.read import load_settings
from rmpa.config.settings import WebSettings
from rmpa.config.values import HOST, BadValue
from rmpa.core.counters import configure_logging
from rmpa.core.errors import ConfigError

if TYPE_CHECKING:
    from rmpa.cli.module import Module
    from rmpa.config.settings import Settings
    from rmpa.web.server.process import Address, WebSetup

_log = logging.getLogger("rmpa.web")
_LIBRARIES = ("aiohttp", "cbor2", "prometheus_client")
_DEFAULTS = WebSettings()
EPILOG = """\
\b
[web] of rmpa.toml and the variables RMPA_WEB_* give the same; options are stronger.
It is as secure as the agent: beside one in a secured mesh it serves HTTPS with the certificate of that module, by its
[[permission]], and begins anew where the agent comes back secured.

\b
Examples:
  rmpa web                        for this machine: http://127.0.0.1:8480/, https:// in a secured mesh
  rmpa web --listen 0.0.0.0       for the network; prints the URL with its token once
  rmpa up --web                   the agent starts it, and again if it ends
  curl -s localhost:8480/api/v1/peers | jq '.[].name'
"""


@click.command(epilog=EPILOG)
@click.option("--port", type=click.IntRange(1, 65535), help=f"Port to listen at. [default: {_DEFAULTS.port}]")
@click.option(
    "--listen",
    metavar="ADDRESS",
    help=f"Address to listen at; beyond this machine a token is needed. [default: {_DEFAULTS.listen}]",
)
@click.option(
    "--token-file",
    metavar="FILE",
    help="Ask clients for the token of this file; made if it is not there. [default: in the state directory]",
)
@click.option(
    "--host", "hosts", metavar="NAME", multiple=True, help="A further name of this server in URLs; repeatable."
)
@click.option(
    "--control",
    is_flag=True,
    help="Let clients publish, call and offer services, and set parameters; they then need the token.",
)
@click.option(
    "--cert",
    metavar="FILE",
    help="HTTPS with this certificate (PEM). [default: the module's, if secured]",
)
@click.option("--key", metavar="FILE", help="Its private key (PEM). [default: in the certificate's file]")
@click.option("--drive", is_flag=True, help="Let the joystick of its pages command a robot; they need the token.")
@click.option("--config", metavar="FILE", help="Settings. [default: ./rmpa.toml, ~/.config/rmpa, /etc/rmpa]")
@click.option("--with-agent", is_flag=True, hidden=True, help="End when standard input ends.")
@click.option("--insecure", is_flag=True, help="Start without an agent although other modules here have keys.")
@agent_option
@json_option
def web(
    port: int | None,
    listen: str | None,
    token_file: str | None,
    hosts: tuple[str, ...],
    control: bool,
    cert: str | None,
    key: str | None,
    drive: bool,
    config: str | None,
    with_agent: bool,
    insecure: bool,
    agent: str | None,
    as_json: bool,
) -> int:
    """Show the mesh in a browser; serve rosbridge and Foxglove clients, /metrics for Prometheus, /api/v1 as JSON.

    It is a process of its own: the agent does not depend on it. It starts without an agent too, and finds it later.
    """
    _check_libraries()

    def with_options(given: WebSettings) -> WebSettings:
        return replace(
            given,
            port=given.port if port is None else port,
            listen=given.listen if listen is None else _host("--listen", listen),
            token_file=given.token_file if token_file is None else token_file,
            control=given.control or control,
            cert=given.cert if cert is None else cert,
            key=given.key if key is None else key,
            drive=given.drive or drive,
            hosts=(*given.hosts, *(_host("--host", name) for name in hosts)),
        )

    def make() -> tuple[Module, WebSetup]:
        module = find_module(agent, {"config": config}, os.environ, "--agent")
        settings = module.loaded.settings
        settings = replace(settings, web=with_options(settings.web))
        if insecure:
            settings = replace(settings, trust=replace(settings.trust, insecure=True))
        return module, _setup(module, settings)

    module, setup = make()
    log = setup.settings
    configure_logging(log.log_level, sys.stderr, as_json=log.log_json)
    for note in module.loaded.notes:
        _log.warning("%s", note)
    from rmpa.web.server.process import serve

    def announce(address: Address) -> None:
        _announce(address, as_json=as_json)

    def load() -> WebSetup:
        return make()[1]

    while True:
        pinned = module.name if module.chosen.source.said else None
        if not asyncio.run(serve(setup, pinned, announce, with_agent=with_agent, load=load)):
            return 0
        module, setup = make()


def _setup(module: Module, settings: Settings) -> WebSetup:
    """What the server of a module is made of; it is as secure as the module's agent.

    Raises:
        RmpaError: A file cannot be used; or no agent runs, the module has no keys, and others have some.
    """
    from rmpa.trust.store import TrustStore, check_open
    from rmpa.web.server.process import WebSetup, access_of
    from rmpa.web.server.tls import certificate_files

    store = TrustStore(module.state, module.name) if module.state is not None else None
    trusted = module.secured or (store is not None and store.exists)
    if not trusted and module.socket is None:
        check_open(settings.trust, module.state, module.name, os.environ, "--agent")
    own_file = str(settings.config_file.absolute()) if settings.config_file is not None else ""
    if trusted and module.config_file not in ("", own_file):  # the permissions are those that its agent reads
        theirs = load_settings({"config": module.config_file}, os.environ, host_name=socket.gethostname())
        settings = replace(settings, trust=theirs.settings.trust)
    files = certificate_files(settings.web.cert, settings.web.key, store if trusted else None)
    access = access_of(settings.web, module.name, os.environ, settings.state_dir)
    folder = str(store.folder) if store is not None else ""
    return WebSetup(settings, access, files, trusted, module.name, folder)


def _check_libraries() -> None:
    missing = [name for name in _LIBRARIES if not _is_there(name)]
    if missing:
        raise ConfigError("rmpa web", f"{' and '.join(missing)} not installed", "run pip install 'rmpa[web]'")


def _is_there(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ValueError:  # it was taken out of sys.modules
        return False


def _host(option: str, text: str) -> str:
    try:
        return HOST.read(text)
    except BadValue as error:
        raise ConfigError(option, error.problem, error.remedy) from None


def _announce(address: Address, *, as_json: bool) -> None:
    if as_json:
        from rmpa.cli.output import print_json

        print_json({"url": address.url, "token_file": address.token_file})
    else:
        click.echo(address.url)
        if address.is_new:
            click.echo(f"the token is kept in {address.token_file}; it is not printed again")
        elif address.token_file:
            click.echo(f"clients need the token of {address.token_file}")
    sys.stdout.flush()
