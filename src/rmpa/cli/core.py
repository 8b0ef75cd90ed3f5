"""``rmpa core``: a ROS core alone."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sys

import click

from rmpa.cli.main import verb
from rmpa.cli.options import flag, option
from rmpa.cli.output import print_text
from rmpa.core.errors import UnreachableError


def _default_port() -> int:
    """The port of ``ROS_MASTER_URI`` if its host is this machine, as for roscore; else 11311."""
    from rmpa.ros.core.embedded import DEFAULT_PORT
    from rmpa.ros.http.rpc import is_own_name, split_uri

    try:
        host, port, _ = split_uri(os.environ.get("ROS_MASTER_URI", ""))
    except UnreachableError:
        return DEFAULT_PORT
    return port if is_own_name(host) or host.startswith("127.") else DEFAULT_PORT


@verb(
    option(
        "-p --port",
        help="Port to listen at; 0 lets the system choose. [default: the port of ROS_MASTER_URI, or 11311]",
        type=click.IntRange(0, 65535),
    ),
    option(
        "--host",
        help="Address to listen at; 0.0.0.0 opens it to the network.",
        default="127.0.0.1",
        show_default=True,
    ),
    option("--advertise", "NAME", "Host name or address that nodes are given, if not --host.", default=""),
    option(
        "--keep",
        help="Restore nodes and parameters of the last run: auto, if one of its nodes runs or the core crashed.",
        type=click.Choice(["auto", "always", "never"]),
        default="auto",
        show_default=True,
    ),
    flag("-v --verbose", "Log every registration."),
    flag("--debug", "Log every call."),
)
def core(port: int | None, host: str, advertise: str, keep: str, verbose: bool, debug: bool) -> None:
    """Run a ROS core: master, parameter server and /rosout, as roscore does."""
    from rmpa.runtime.accept import raise_file_limit

    level = logging.DEBUG if debug else logging.INFO if verbose else logging.WARNING
    logging.basicConfig(level=level, format="%(asctime)s %(levelname)-7s %(name)s %(message)s")
    raise_file_limit()
    asyncio.run(_run_core(host, _default_port() if port is None else port, advertise, keep))


async def _run_core(host: str, port: int, advertised: str, keep: str) -> None:
    from rmpa import __version__
    from rmpa.config.module_name import core_file
    from rmpa.ros.core.embedded import ROS_VERSION, RosCore
    from rmpa.ros.environment import shown_uri

    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    state = core_file(os.environ, port)
    core = RosCore(host, port, advertised_host=advertised, on_shutdown=lambda _: ended.set(), state=state, keep=keep)
    await core.start()
    print_text(
        f"rmpa core {__version__}, in place of ros_comm {ROS_VERSION.strip()}",
        f"ROS_MASTER_URI={shown_uri(core.uri)}",
        f"setting /run_id to {core.call('getParam', '/rmpa_core', '/run_id').value}",
        "started core service [/rosout]",
        [text] if core.stored is not None and (text := core.stored.restored()) else [],
    )
    sys.stdout.flush()
    await ended.wait()
    print_text("shutting down")
    await core.close()
