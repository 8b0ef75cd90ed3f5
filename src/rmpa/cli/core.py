"""``rmpa core``: the ROS core alone, in place of ``roscore``."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sys

import click

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


@click.command()
@click.option(
    "-p",
    "--port",
    type=click.IntRange(0, 65535),
    default=None,
    help="Port to listen at; 0 lets the system choose. [default: the port of ROS_MASTER_URI, or 11311]",
)
@click.option(
    "--host", default="127.0.0.1", show_default=True, help="Address to listen at; 0.0.0.0 opens it to the network."
)
@click.option("--advertise", default="", metavar="NAME", help="Host name or address that nodes get, if not --host.")
@click.option(
    "--keep",
    type=click.Choice(["auto", "always", "never"]),
    default="auto",
    show_default=True,
    help="Take up nodes and parameters of the run before: auto, if a node of it still runs or the core died.",
)
@click.option("-v", "--verbose", is_flag=True, help="Log every registration.")
@click.option("--debug", is_flag=True, help="Log every call.")
def core(port: int | None, host: str, advertise: str, keep: str, verbose: bool, debug: bool) -> None:
    """Run a ROS core: master, parameter server and /rosout, as roscore does."""
    from rmpa.runtime.accept import raise_file_limit

    level = logging.DEBUG if debug else logging.INFO if verbose else logging.WARNING
    logging.basicConfig(level=level, format="%(asctime)s %(levelname)-7s %(name)s %(message)s")
    raise_file_limit()
    asyncio.run(_run(host, _default_port() if port is None else port, advertise, keep=keep))


async def _run(host: str, port: int, advertise: str, *, keep: str) -> None:
    from rmpa import __version__
    from rmpa.config.module_name import core_file
    from rmpa.ros.core.embedded import ROS_VERSION, RosCore

    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    core = RosCore(
        host,
        port,
        advertised_host=advertise,
        on_shutdown=lambda _: ended.set(),
        state=core_file(os.environ, port),
        keep=keep,
    )
    await core.start()
    click.echo(f"rmpa core {__version__}, in place of ros_comm {ROS_VERSION.strip()}")
    click.echo(f"ROS_MASTER_URI={core.uri}")
    click.echo(f"setting /run_id to {core.call('getParam', '/rmpa_core', '/run_id').value}")
    click.echo("started core service [/rosout]")
    if core.stored is not None and (text := core.stored.restored()):
        click.echo(text)
    sys.stdout.flush()
    await ended.wait()
    click.echo("shutting down")
    await core.close()
