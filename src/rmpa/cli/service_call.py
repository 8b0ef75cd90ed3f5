"""``rmpa service call``: one call, with a request in YAML or JSON."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Final

import click

from rmpa.cli.graph import read_graph, read_name, require_peer
from rmpa.cli.message_text import to_text
from rmpa.cli.options import FiniteRange, GraphOptions, completes, graph_options
from rmpa.cli.output import print_json, printable
from rmpa.cli.service_probe import CALLER_ID, known_type, lookup
from rmpa.cli.topic_pub import fill_stamps, read_values
from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError

if TYPE_CHECKING:
    from rmpa.cli.graph import GraphName
    from rmpa.cli.master import Master
    from rmpa.ros.types.messages import Plain

_LOOK: Final = 0.1
"""Seconds between two questions to the master whether the service is there."""


@click.command(
    context_settings={"ignore_unknown_options": True},
    epilog="""\
\b
The request is one YAML value, or one for each field in order; what is not given is 0, empty or false.
Its type is the server's; its definition comes with rmpa, or from this machine's ROS packages (PYTHONPATH,
ROS_PACKAGE_PATH, CMAKE_PREFIX_PATH).

\b
Examples:
  rmpa service call /add_two_ints 20 22
  rmpa service call /arm/enable '{data: true}'
  rmpa service call base:/plan '{start: {header: auto}}' --timeout 120
  rmpa service call /map_server/static_map --wait --json | jq .response.map.info
""",
)
@click.argument("service", shell_complete=completes("service"))
@click.argument("values", nargs=-1)
@click.option("-w", "--wait", is_flag=True, help="Wait until the service is there, for as long as --timeout says.")
@click.option(
    "-t", "--timeout", type=FiniteRange(0.001), default=60.0, show_default=True, help="Seconds for the answer."
)
@graph_options
def call(service: str, values: tuple[str, ...], wait: bool, timeout: float, options: GraphOptions) -> None:
    """Call a SERVICE with VALUES, in YAML or JSON, and print its response.

    An error of the server goes to stderr in its own words, and the exit code is 1.
    """
    wanted = read_name(service, "service")
    plain = read_values(values)
    master = options.master()
    began = time.monotonic()
    response = asyncio.run(_call(master, wanted, plain, timeout, wait=wait))
    if options.as_json:
        print_json({"service": wanted.name, "response": response, "took": time.monotonic() - began})
    elif response:
        click.echo(to_text(response))


async def _call(
    master: Master,
    wanted: GraphName,
    plain: Plain,
    timeout: float,  # noqa: ASYNC109 - the user's
    *,
    wait: bool,
) -> dict[str, Plain]:
    from rmpa.ros.node.service_client import ServiceConnection

    if wait:
        await _wait(master, wanted, timeout)
    graph = await read_graph(master)
    require_peer(master, graph, wanted)
    graph.require_service(wanted)
    uri = await lookup(master, wanted.name)
    connection = await ServiceConnection.open(uri, wanted.name, CALLER_ID, timeout=timeout)
    try:
        kind = known_type(connection.description)
        request = kind.request.serialize(kind.request.make(fill_stamps(plain, time.time_ns())))
        ok, body = await connection.call(request, timeout)
    finally:
        connection.close()
    if not ok:
        text = printable(str(bytes(body), "utf-8", "replace")) or "it gave no reason"
        raise PeerRefused(f"service {wanted.name}", text)
    return kind.response.to_plain(kind.response.deserialize(body))


async def _wait(master: Master, wanted: GraphName, timeout: float) -> None:  # noqa: ASYNC109 - likewise
    """Wait until a service is registered, by the peer if one is named.

    Raises:
        UnreachableError: It is not in time.
    """
    last: RmpaError | None = None
    try:
        async with asyncio.timeout(timeout):
            while True:
                try:
                    (await read_graph(master)).require_service(wanted)
                except RmpaError as error:
                    last = error
                else:
                    return
                await asyncio.sleep(_LOOK)
    except TimeoutError:
        remedy = str(last) if last is not None else ""
        raise UnreachableError(f"service {wanted}", f"{master.uri} within {timeout:g} s", remedy) from None
