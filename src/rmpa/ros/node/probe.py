"""Finds out whether the TCPROS server of a node can be reached, without a trace at that node.

rospy reads the header of a connection in the thread that accepts, so that one that says nothing shuts out all others
(trap 11); and it logs a warning for each connection whose header does not come, or is for a topic or service that it
does not have. A service's probe (wiki.ros.org/ROS/TCPROS, section 1.1; what ``wait_for_service`` sends) avoids both:
its header leaves with the connect, and the node answers with its own header and closes.
"""

from __future__ import annotations

import asyncio
import os
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RemoteProtocolError, UnreachableError
from rmpa.core.limits import KIB
from rmpa.ros.http.client import connect
from rmpa.ros.wire.services import client_header
from rmpa.ros.wire.tcpros import encode_header, parse_header, printable
from rmpa.runtime.accept import is_shortage

if TYPE_CHECKING:
    import socket

    from rmpa.ros.wire.tcpros import Header

_CALLER_ID: Final = "/rmpa"
_CHUNK: Final = 64 * KIB


async def probe(
    address: str,
    port: int,
    service: str,
    *,
    timeout: float,  # noqa: ASYNC109 - the result names it
    node: str = "",
) -> str:
    """Connect to a node's TCPROS server, and let it answer.

    A header with ``error`` counts as an answer of ``node`` only if it names that node, by ``callerid`` or as rospy's
    text does: any other TCPROS server that has taken the port says the same.

    Args:
        address: An IPv4 address.
        port: The port of the server, as ``requestTopic`` and ``lookupService`` tell it.
        service: A service of the node: every rospy and roscpp node has ``NODE/get_loggers``. If it has none, or
            another node is there, that node logs an error. With an empty text nothing is sent, and the connection is
            closed at once: it shows that a program listens there, and rospy logs a warning.
        timeout: Seconds for all of it.
        node: The node that is expected; empty accepts any.

    Returns:
        An empty text if the server answers, else the reason, ready to read.
    """
    sock: socket.socket | None = None
    try:
        async with asyncio.timeout(timeout):
            sock = await connect(address, port)
            if not service:
                return ""
            header = client_header(service, _CALLER_ID, probe=True)
            return _judge(await exchange_headers(sock, header), node)
    except TimeoutError:
        return f"no answer within {timeout:g} s" if sock is None else f"connected, but no answer within {timeout:g} s"
    except RemoteProtocolError:
        return "the program that listens there is no ROS node"
    except UnreachableError as error:
        return str(error)
    except OSError as error:
        if is_shortage(error):
            return "no file descriptor is left for the attempt; `rmpa doctor` says what to do"
        text = os.strerror(error.errno) if error.errno else str(error)
        return text[:1].lower() + text[1:]
    finally:
        if sock is not None:
            sock.close()


async def exchange_headers(sock: socket.socket, header: Header) -> Header | None:
    """Send a connection header, and return the one that comes, or ``None`` if the other side closes before.

    Args:
        sock: A non-blocking connection.
        header: The fields to send.

    Raises:
        RemoteProtocolError: What comes is no header, or too large.
        OSError: The connection broke.
    """
    loop = asyncio.get_running_loop()
    await loop.sock_sendall(sock, encode_header(header))
    data = b""
    while True:
        fields, _, _ = parse_header(data)
        if fields is not None:
            return fields
        chunk = await loop.sock_recv(sock, _CHUNK)
        if not chunk:
            return None
        data += chunk


def _judge(fields: Header | None, node: str) -> str:
    if fields is None:
        return "the program that listens there closed the connection without an answer"
    name, error = fields.get("callerid", ""), fields.get("error")
    if node and name and name != node:
        return f"another node listens there: {printable(name)}"
    if error is None or (node and (name == node or error.startswith(f"[{node}] "))):
        return ""
    return f"a ROS node listens there, but not the expected one: {printable(error)}"
