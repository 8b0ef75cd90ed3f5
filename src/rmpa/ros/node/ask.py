"""What a node of another process is asked, and what it answers: by its slave API, or by the headers of TCPROS.

A header is asked for with a connection that ends after it. rospy reads the header of a connection in the thread that
accepts, so that one that says nothing shuts out all others (trap 11); and it logs a warning for each connection whose
header does not come, or is for a topic or service that it does not have.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from itertools import islice
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import OutOfDescriptors, PeerRefused, RemoteProtocolError, RmpaError, UnreachableError
from rmpa.core.limits import KIB
from rmpa.ros import limits
from rmpa.ros.environment import NodeConnection, NodePing
from rmpa.ros.http.rpc import call, call_api, connect, split_uri
from rmpa.ros.wire import tcpros
from rmpa.ros.wire.slave_api import TCPROS, read_bus_info
from rmpa.ros.wire.xmlrpc import RosFault, RosReply
from rmpa.runtime.accept import Use, is_shortage

if TYPE_CHECKING:
    import socket
    from collections.abc import Mapping, Sequence

_log = logging.getLogger(__name__)

# Time for a connection that only shows that a node is there.
_CONNECT_TIMEOUT: Final = 3.0
# Seconds between two checks whether a node that was asked to end has ended.
_NODE_KILL_LOOK: Final = 0.2
# Connections of one node that are told: some 80 kB in one answer, and more than can be read.
_NODE_CONNECTIONS_SHOWN: Final = 500
# The node that asks a node for its name.
IDENTIFY_ID: Final = "/rmpa_identify"
_TOPICS_ASKED: Final = 2
_PORT_MAX: Final = 65535


async def exchange_headers(sock: socket.socket, header: tcpros.Header) -> tcpros.Header | None:
    """Send a connection header, and return the one that comes, or ``None`` if the other side closes before.

    Args:
        sock: A non-blocking connection.
        header: The fields to send.

    Raises:
        RemoteProtocolError: What comes is no header, or too large.
        OSError: The connection broke.
    """
    await asyncio.get_running_loop().sock_sendall(sock, tcpros.encode_header(header))
    return await read_header(sock)


async def read_header(sock: socket.socket) -> tcpros.Header | None:
    """The connection header that comes, or ``None`` if the other side closes before; errors as above."""
    loop, data = asyncio.get_running_loop(), bytearray()
    while True:
        fields, _, wanted = tcpros.parse_header(data)
        if fields is not None:
            return fields
        # What follows the header is left to the caller. A part at a time: the other side may send few bytes of many.
        chunk = await loop.sock_recv(sock, min(wanted - len(data), 64 * KIB))
        if not chunk:
            return None
        data += chunk


async def request_topic(
    uri: str,
    topic: str,
    caller_id: str,
    *,
    timeout: float = limits.SLAVE_CALL_TIMEOUT,  # noqa: ASYNC109 - the message names it
    use: Use = Use.DATA,
) -> tuple[str, int]:
    """Ask a publisher where its topic is to be had by TCPROS: host and port.

    Args:
        uri: Its slave API.
        topic: The topic.
        caller_id: The asking node.
        timeout: Seconds.
        use: The purpose of the connection.

    Raises:
        RemoteProtocolError: It does not publish that topic, or its answer is malformed.
        RmpaError: As for ``call_api``.
    """
    reply = await call_api(uri, "requestTopic", caller_id, topic, [[TCPROS]], timeout=timeout, use=use)
    match reply.value:
        case [str(protocol), str(host), int(port)] if reply.code == 1 and protocol == TCPROS:
            if 0 < port <= _PORT_MAX:
                return host, port
    raise RemoteProtocolError(f"{uri} answers requestTopic with {reply.code}: {tcpros.printable(reply.status)}")


async def ask_publisher(uri: str, topic: str, caller_id: str, use: Use = Use.DATA) -> tcpros.Header:
    """Connect to a publisher, and return the header that it answers; an empty one where it sends none.

    Args:
        uri: Its slave API.
        topic: The topic.
        caller_id: The asking node. It must not be that of a subscriber of the topic: a rospy publisher keeps one
            connection for each caller id.
        use: The purpose of the connection.

    Raises:
        RmpaError: The publisher does not answer as one does.
        OSError: The connection fails.
    """
    with await connect(*await request_topic(uri, topic, caller_id, use=use), use) as sock:
        return await exchange_headers(sock, tcpros.subscriber_header(topic, caller_id)) or {}


async def name_at(api: str, topics: Sequence[str] = ()) -> str | None:
    """Ask the node with this slave API for its name.

    rospy has ``getName``. roscpp has not, but sends its name in the header of every topic that it publishes, and
    every node publishes ``/rosout``.

    Args:
        api: The slave API's URI.
        topics: Other topics that the node may publish.

    Returns:
        Its name, or ``None`` if it cannot be found out.

    Raises:
        UnreachableError: The slave API does not answer.
    """
    with contextlib.suppress(RosFault, RemoteProtocolError):
        reply = await call_api(api, "getName", IDENTIFY_ID, use=Use.CORE)
        if reply.code == 1 and isinstance(reply.value, str):
            return reply.value
    for topic in dict.fromkeys(["/rosout", *topics][:_TOPICS_ASKED]):
        try:
            async with asyncio.timeout(limits.SLAVE_CALL_TIMEOUT):
                fields = await ask_publisher(api, topic, IDENTIFY_ID, Use.CORE)
        except (RosFault, RemoteProtocolError, OSError) as error:
            _log.debug("= %s does not tell its name for %s: %s", api, topic, error)
            continue
        if "callerid" in fields:
            return fields["callerid"]
    return None


async def probe(
    address: str,
    port: int,
    service: str,
    *,
    timeout: float,  # noqa: ASYNC109 - the result names it
    node: str = "",
) -> str:
    """Find out whether the TCPROS server of a node can be reached, without a trace at that node.

    A service's probe (wiki.ros.org/ROS/TCPROS, section 1.1; what ``wait_for_service`` sends) is sent: its header
    leaves with the connect, and the node answers with its own header and closes. A header with ``error`` counts as an
    answer of ``node`` only if it names that node, by ``callerid`` or as rospy's text does: any other TCPROS server
    that has taken the port says the same.

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
    connected = ""
    try:
        async with asyncio.timeout(timeout):
            with await connect(address, port) as sock:
                connected = "connected, but "
                if not service:
                    return ""
                header = tcpros.client_header(service, "/rmpa", probe=True)
                return _judge(await exchange_headers(sock, header), node)
    except TimeoutError:
        return f"{connected}no answer within {timeout:g} s"
    except RemoteProtocolError:
        return "the program that listens there is no ROS node"
    except UnreachableError as error:
        return str(error)
    except OSError as error:
        if is_shortage(error):
            return "no file descriptor is left for the attempt; `rmpa doctor` says what to do"
        text = os.strerror(error.errno) if error.errno else str(error)
        return text[:1].lower() + text[1:]


def _judge(fields: tcpros.Header | None, node: str) -> str:
    if fields is None:
        return "the program that listens there closed the connection without an answer"
    name, error = fields.get("callerid", ""), fields.get("error")
    if node and name and name != node:
        return f"another node listens there: {tcpros.printable(name)}"
    if error is None or (node and (name == node or error.startswith(f"[{node}] "))):
        return ""
    return f"a ROS node listens there, but not the expected one: {tcpros.printable(error)}"


async def refuses(api: str) -> bool:
    """Whether connects to a slave API are refused; ``False`` where that cannot be found out."""
    try:
        await try_connect(api)
    except OutOfDescriptors:
        pass
    except ConnectionRefusedError:
        return True
    return False


async def try_connect(api: str) -> str:
    """Connect to a slave API and close the connection; return why it cannot be reached, or an empty text.

    Raises:
        ConnectionRefusedError: Nothing listens at that address.
        OutOfDescriptors: No file descriptor is left for the attempt.
    """
    try:
        host, port, _ = split_uri(api)
        async with asyncio.timeout(_CONNECT_TIMEOUT):
            sock = await connect(host, port, Use.CORE)
    except ConnectionRefusedError:
        raise
    except TimeoutError:
        return f"no answer in {_CONNECT_TIMEOUT:g} s"
    except UnreachableError as error:
        return error.remedy or str(error)
    except OSError as error:
        if is_shortage(error):
            raise OutOfDescriptors("node", api) from error
        return os.strerror(error.errno) if error.errno else str(error)
    sock.close()
    return ""


async def ping_node(node: str, uri: str, caller_id: str) -> NodePing:
    """Ask a node for its process id, and measure the time of the call.

    Args:
        node: Its name, for errors.
        uri: Its slave API.
        caller_id: The asking node's name.

    Raises:
        UnreachableError: The node does not answer.
        PeerRefused: The node answers with an error.
        RemoteProtocolError: The answer is malformed.
    """
    loop = asyncio.get_running_loop()
    begin = loop.time()
    reply = await _call(node, uri, "getPid", caller_id)
    if reply.code != 1 or not isinstance(reply.value, int):
        raise PeerRefused(node, reply.status or "it does not say its process id")
    return NodePing(uri=uri, time=loop.time() - begin, pid=reply.value)


async def node_connections(uri: str, caller_id: str, names: Mapping[str, str]) -> tuple[NodeConnection, ...] | None:
    """Ask a node for its connections; ``None`` if it does not answer.

    Args:
        uri: Its slave API.
        caller_id: The asking node's name.
        names: Nodes by their slave APIs: of a publisher a subscriber knows that address alone.
    """
    try:
        links = read_bus_info(await call(uri, "getBusInfo", caller_id))
    except RmpaError:
        return None
    found = (NodeConnection(one.topic, one.inbound, names.get(one.other, one.other), one.connected) for one in links)
    return tuple(islice(found, _NODE_CONNECTIONS_SHOWN))


async def end_node(node: str, uri: str, caller_id: str, reason: str) -> bool:
    """Ask a node to end, and wait up to ``limits.NODE_KILL_WAIT`` until it has.

    Args:
        node: Its name, for errors.
        uri: Its slave API.
        caller_id: The asking node's name.
        reason: For the node's log.

    Returns:
        Whether nothing listens at its slave API any more.

    Raises:
        UnreachableError: The node does not answer, and its port does not refuse connections.
        PeerRefused: The node refuses.
        RemoteProtocolError: The answer is malformed.
    """
    try:
        reply = await _call(node, uri, "shutdown", caller_id, reason)
    except (UnreachableError, RemoteProtocolError):
        # A node may end before it answers.
        if not await refuses(uri):
            raise
        return True
    if reply.code != 1:
        raise PeerRefused(node, reply.status or "it does not end")
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(limits.NODE_KILL_WAIT):
            while not await refuses(uri):  # noqa: ASYNC110 - the port of another process
                await asyncio.sleep(_NODE_KILL_LOOK)
            return True
    return False


async def _call(node: str, uri: str, method: str, *params: str) -> RosReply:
    try:
        return await call_api(uri, method, *params)
    except RosFault as error:
        raise PeerRefused(node, error.text) from error
