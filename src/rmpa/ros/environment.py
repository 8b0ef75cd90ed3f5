"""The ROS_* environment variables, the remapping arguments, and what is told of a node.

Reads the ROS_* environment variables and the remapping arguments of a node.

Sources: wiki.ros.org/ROS/EnvironmentVariables, wiki.ros.org/Remapping%20Arguments. An argument overrides a variable.
Pure: variables, arguments and the machine's addresses are passed in.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from dataclasses import dataclass, field
from itertools import chain
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.core.errors import ConfigError
from rmpa.core.identity import is_legal_name, resolve_name

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from rmpa.core.timers import Yielder
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

DEFAULT_MASTER_URI: Final = "http://localhost:11311"
_URI: Final = re.compile(r"http://(?P<host>\[[0-9A-Fa-f:.]+\]|[^\s/:\[\]]+):(?P<port>[0-9]{1,5})/?")
_SPECIAL: Final = ("__name", "__ns", "__ip", "__hostname", "__master", "__log")
_PORT_MAX: Final = 65535


@dataclass(frozen=True, slots=True)
class RosEnvironment:
    """A node's master, address, namespace, name and remappings.

    Args:
        master_uri: The master's URI.
        host: The address to register.
        host_given: Whether a variable or argument sets ``host``. Otherwise it is the machine's first address that is
            not a loopback address, or 127.0.0.1.
        namespace: A global name, in which names are resolved.
        name: Replaces the node's own name; empty for none.
        remappings: From name to name, both as they were written.
        parameters: Private parameters (``_key:=value``) with their values, keys without the underscore.
        arguments: All other arguments.
    """

    master_uri: str = DEFAULT_MASTER_URI
    host: str = "127.0.0.1"
    host_given: bool = False
    namespace: str = "/"
    name: str = ""
    remappings: Mapping[str, str] = field(default_factory=dict)
    parameters: Mapping[str, XmlRpcValue] = field(default_factory=dict)
    arguments: tuple[str, ...] = ()

    @classmethod
    def read(
        cls, variables: Mapping[str, str], arguments: Sequence[str] = (), addresses: Sequence[str] = ()
    ) -> RosEnvironment:
        """Read the variables and the arguments after the program's name.

        Args:
            variables: As in ``os.environ``.
            arguments: As in ``sys.argv[1:]``.
            addresses: This machine's IPv4 addresses, best first.

        Raises:
            ConfigError: A variable or an argument cannot be used.
        """
        special, remappings, parameters, rest = _split(arguments)
        values = {**variables, **special}

        def given(*sources: str) -> tuple[str, str]:
            return next(((source, values[source]) for source in sources if values.get(source)), ("", ""))

        source, host = given("__hostname:=", "__ip:=", "ROS_HOSTNAME", "ROS_IP")
        if "://" in host:
            raise ConfigError(source, f"{host!r} is a URI", "write the host alone, without http://")
        if host and not re.fullmatch(r"[A-Za-z0-9_.:-]+", host):
            raise ConfigError(source, f"{host!r} is neither a host name nor an address")
        source, uri = given("__master:=", "ROS_MASTER_URI")
        match = _URI.fullmatch(uri.strip())
        if uri and (match is None or not 0 < int(match["port"]) <= _PORT_MAX):
            raise ConfigError(source, f"{uri!r} is not a master's URI", f"write it like {DEFAULT_MASTER_URI}")
        source, namespace = given("__ns:=", "ROS_NAMESPACE")
        if not is_legal_name(namespace) or namespace.startswith("~"):
            raise ConfigError(source, f"{namespace!r} is not a namespace", "write it like /robot")
        source, name = given("__name:=")
        if not is_legal_name(name) or name.startswith("~") or "/" in name:
            raise ConfigError(source, f"{name!r} is not a node's base name", "use letters, digits and _, and __ns:=")
        outer = next((address for address in addresses if not is_loopback(address)), "127.0.0.1")
        return cls(
            master_uri=uri.strip() or DEFAULT_MASTER_URI,
            host=host or outer,
            host_given=bool(host),
            namespace=resolve_name(namespace),
            name=name,
            remappings=remappings,
            parameters=parameters,
            arguments=rest,
        )

    def node_name(self, name: str) -> str:
        """The global name of a node that calls itself ``name``.

        Raises:
            ValueError: The name is not a legal one.
        """
        if not name.strip("~/"):
            raise ValueError(f"{name!r} is not a node's name: it names the root namespace")
        return resolve_name(self.name or name, self.namespace)

    def resolve(self, name: str, node: str) -> str:
        """Resolve and remap a name that a node uses.

        Args:
            name: The name, as the node writes it.
            node: The node's global name.

        Raises:
            ValueError: The name is not a legal one.
        """
        resolved = resolve_name(name, self.namespace, node)
        for source, target in self.remappings.items():
            if resolve_name(source, self.namespace, node) == resolved:
                return resolve_name(target, self.namespace, node)
        return resolved


def is_loopback(host: str) -> bool:
    """Whether a host, as written in a URI, is a loopback address or name."""
    return host in ("localhost", "::1", "[::1]") or re.fullmatch(r"127(\.[0-9]+){3}", host) is not None


def host_of(uri: str) -> str:
    """The host in a ROS URI; empty if the text is not one."""
    match = _URI.fullmatch(uri)
    return match["host"] if match else ""


def shown_uri(uri: str) -> str:
    """A master's URI as users see and type it: ``http://localhost:11311``."""
    uri = uri.rstrip("/")
    return uri.replace("//127.0.0.1:", "//localhost:")


def parse_value(text: str) -> XmlRpcValue:
    """Parse a parameter's value from the command line: a number, boolean, JSON list, object or string, else the text.

    rosparam reads YAML here; this covers its usual part.
    """
    lowered = text.strip().lower()
    if lowered in ("true", "false"):
        return lowered == "true"
    if re.fullmatch(r"[+-]?[0-9]+", lowered) and abs(int(lowered)) < 1 << 31:
        return int(lowered)
    if re.fullmatch(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)(e[+-]?[0-9]+)?", lowered):
        return float(lowered)
    if text[:1] in ("[", "{", '"'):
        try:
            value: XmlRpcValue = json.loads(text)
        except ValueError:
            return text
        return value
    return text


def _split(
    arguments: Sequence[str],
) -> tuple[dict[str, str], dict[str, str], dict[str, XmlRpcValue], tuple[str, ...]]:
    special: dict[str, str] = {}
    remappings: dict[str, str] = {}
    parameters: dict[str, XmlRpcValue] = {}
    rest = []
    for argument in arguments:
        key, separator, value = argument.partition(":=")
        if not separator or not key or key.startswith("-"):
            rest.append(argument)
        elif key in _SPECIAL:
            special[f"{key}:="] = value
        elif key.startswith("__"):
            raise ConfigError(f"{key}:=", "is not an argument of ROS", f"use one of {', '.join(_SPECIAL)}")
        elif key.startswith("_"):
            parameters[key[1:]] = parse_value(value)
        elif is_legal_name(key) and value and is_legal_name(value):
            remappings[key] = value
        else:
            raise ConfigError(argument, "does not remap one ROS name to another", "write from:=to")
    return special, remappings, parameters, tuple(rest)


class NodeLine(msgspec.Struct, frozen=True):
    """One node in a list.

    Attributes:
        name: Its name in its own graph.
        uri: Its slave API; empty if the master does not have it.
        publications: Number of topics that it publishes.
        subscriptions: Number of topics that it subscribes to.
        services: Number of services that it provides.
        problem: Why its core cannot connect to it, for people; empty if it can, or has not tried.
    """

    name: str
    uri: str = ""
    publications: int = 0
    subscriptions: int = 0
    services: int = 0
    problem: str = ""


class NodeConnection(msgspec.Struct, frozen=True):
    """One connection of a node over which messages of a topic go, as the node tells it (``getBusInfo``).

    Attributes:
        topic: The topic.
        inbound: Whether it is from a publisher; else it is to a subscriber.
        other: The node at its other end; that node's slave API where the name is not known.
        connected: Whether messages can flow, as far as the node knows.
    """

    topic: str
    inbound: bool
    other: str
    connected: bool = True


class NodeFacts(msgspec.Struct, frozen=True):
    """Everything known of one node.

    Attributes:
        name: Its name in its own graph.
        uri: Its slave API.
        pid: Its process id; ``None`` if it did not answer.
        problem: Why it did not answer, for people; empty if it did.
        publications: Types by topic; ``*`` for an unknown type.
        subscriptions: Types by topic.
        services: The names of its services.
        connections: What it tells of its connections; ``None`` where it does not, or an earlier release answers.
    """

    name: str
    uri: str = ""
    pid: int | None = None
    problem: str = ""
    publications: dict[str, str] = {}
    subscriptions: dict[str, str] = {}
    services: tuple[str, ...] = ()
    connections: tuple[NodeConnection, ...] | None = None


class NodeCost(msgspec.Struct, frozen=True, kw_only=True):
    """What the process of a node costs.

    Attributes:
        node: Its name.
        pid: Its process; ``None``: it does not answer, or runs on another machine.
        cpu: Processor time as a share of one core, since it was last asked for.
        rss: Bytes of memory that it holds.
        threads: Its threads.
        since: Since when it runs, in Unix seconds.
        started_by: The resource that has started it; empty: none.
    """

    node: str
    pid: int | None = None
    cpu: float = 0.0
    rss: int = 0
    threads: int = 0
    since: float = 0.0
    started_by: str = ""


class NodePing(msgspec.Struct, frozen=True):
    """One answer of a node to a ping.

    Attributes:
        uri: Its slave API.
        time: Seconds from the call to the answer, measured on the node's machine.
        pid: Its process id.
    """

    uri: str
    time: float
    pid: int


class PeerNodes(msgspec.Struct, frozen=True):
    """One module's nodes.

    Attributes:
        peer: The peer's name.
        nodes: Its own nodes.
        problem: Why the peer did not answer, for people; then ``nodes`` are its proxies in this graph.
    """

    peer: str
    nodes: tuple[NodeLine, ...] = ()
    problem: str = ""


def list_nodes(
    publishers: Mapping[str, Collection[str]],
    subscribers: Mapping[str, Collection[str]],
    services: Mapping[str, Collection[str]],
    uris: Mapping[str, str],
    problems: Mapping[str, str],
    yielder: Yielder = iter,
) -> tuple[NodeLine, ...]:
    """List every node of a graph, sorted by name.

    Args:
        publishers: Nodes by topic.
        subscribers: Nodes by topic.
        services: Nodes by service.
        uris: Known slave APIs by node.
        problems: By node: why connecting to it fails.
        yielder: Iterates, and serves pending data in between, in graphs of thousands of topics.
    """
    tables = (publishers, subscribers, services)
    topics, readers, servers = (Counter(chain.from_iterable(yielder(list(table.values())))) for table in tables)
    return tuple(
        NodeLine(node, uris.get(node, ""), topics[node], readers[node], servers[node], problems.get(node, ""))
        for node in sorted(topics.keys() | readers.keys() | servers.keys())
    )


def describe_node(
    node: str,
    uri: str,
    publishers: Mapping[str, Collection[str]],
    subscribers: Mapping[str, Collection[str]],
    services: Mapping[str, Collection[str]],
    types: Mapping[str, str],
) -> NodeFacts:
    """The registrations of one node; the node itself is not asked.

    Args:
        node: Its name.
        uri: Its slave API.
        publishers: Nodes by topic.
        subscribers: Nodes by topic.
        services: Nodes by service.
        types: Known types by topic.
    """
    return NodeFacts(
        node,
        uri,
        publications={topic: types.get(topic, "*") for topic in sorted(publishers) if node in publishers[topic]},
        subscriptions={topic: types.get(topic, "*") for topic in sorted(subscribers) if node in subscribers[topic]},
        services=tuple(service for service in sorted(services) if node in services[service]),
    )
