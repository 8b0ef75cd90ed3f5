"""The agent's settings: each is declared once here; ``config.schema`` says what follows from a declaration.

``config.read`` reads them from the file, the environment and the command line. The reference for users,
docs/reference/settings.md, is made from this module by ``scripts/write-reference``. The JSON Schema is made here.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, is_dataclass
from enum import StrEnum
from functools import cache
from typing import TYPE_CHECKING, Final

from rmpa.config import limits, peer_rules
from rmpa.config.rules import CONTRACT_RULES, PARAM_RULES, FollowRule, GatewaySettings
from rmpa.config.schema import setting, settings_of, switch, table
from rmpa.config.values import (
    BOUND,
    BYTES_A_SECOND,
    DOMAIN,
    DSCP,
    HOST,
    HOST_PORT,
    INTERFACE,
    MASTER_URI,
    MULTICAST,
    NAME,
    NAME_OR_EMPTY,
    NODE_GLOB,
    PACKET_PRIORITY,
    PARAM_GLOB,
    PEER,
    PEER_GLOB,
    PORT,
    RATE,
    SERVICE_GLOB,
    TEXT,
    TIMEOUT,
    TOPIC_GLOB,
    TYPE_GLOB,
    HostPort,
    Multicast,
    duration_of,
    list_of,
    whole_number,
    word_of,
)
from rmpa.core.contract import DEFAULT_TRANSPORT, ContractRule, Contracts, Transport

if TYPE_CHECKING:
    from pathlib import Path

    from rmpa.config.values import JsonSchema


@dataclass(frozen=True, slots=True)
class ServiceSettings:
    """Which services cross, how long a call may take, and its path.

    Of ``rules`` the first that fits a service and says a time-out gives its time-out; its transport likewise.
    """

    allow: tuple[str, ...] = setting(("/**",), list_of(SERVICE_GLOB), "Services that may cross, by their names here.")
    deny: tuple[str, ...] = setting((), list_of(SERVICE_GLOB), "Services that do not cross.")
    loggers: bool = switch("Whether each node's get_loggers and set_logger_level cross too.")
    timeout: float = setting(
        limits.SERVICE_TIMEOUT,
        TIMEOUT,
        "How long a call may take, in seconds or as a text such as 500 ms; then the caller gets an error.",
    )
    transport: Transport = setting(
        DEFAULT_TRANSPORT,
        peer_rules.TRANSPORT,
        "How calls travel, unless a [[service]] says otherwise; the values are those of bridge.transport.",
    )
    rules: tuple[peer_rules.ServiceRule, ...] = setting(
        (),
        peer_rules.SERVICE_RULES,
        "Time-outs and transports of single services; for each, the first rule that matches applies.",
        key="service",
    )


@dataclass(frozen=True, slots=True)
class NodeSettings:
    """Rights of peers over this module's nodes."""

    kill: tuple[str, ...] = setting(
        ("/**",), list_of(NODE_GLOB), "Nodes that peers may end (rosnode kill, rmpa node kill)."
    )


@dataclass(frozen=True, slots=True)
class ResourceSettings:
    """From where the agent starts Smart Resources, and who may ask it to."""

    folder: str = setting(
        "",
        TEXT,
        "The folder of the files NAME.resource.toml and NAME.py that may be started, such as "
        "~/.config/rmpa/resources; no other user may write there.",
        shown_default="none: nothing is started",
    )
    start: bool = switch("Start those with boot = true in their table [start].", default=True)
    open: bool = switch(
        "In a mesh that is not secured every program in the network may then start, stop and read what is in the "
        "folder; in a secured mesh a [[permission]] with launch says who may.",
        live=True,
    )


@dataclass(frozen=True, slots=True)
class ParamSettings:
    """Rights of peers over this module's parameters; the peers' parameters that it follows (none within another)."""

    remote_get: tuple[str, ...] = setting(("/**",), list_of(PARAM_GLOB), "Parameters that peers may read and follow.")
    remote_set: tuple[str, ...] = setting(("/**",), list_of(PARAM_GLOB), "Parameters that peers may set and delete.")
    follow: tuple[FollowRule, ...] = setting(
        (), PARAM_RULES, "Parameters of peers that this module follows.", key="param"
    )


@dataclass(frozen=True, slots=True)
class TimeSettings:
    """Simulated time (``/use_sim_time`` and ``/clock``) across modules."""

    follow: str = setting("", NAME_OR_EMPTY, "The peer whose simulated time is used here; empty: none.")
    share: bool = switch("Whether peers may follow this module's time.")


@dataclass(frozen=True, slots=True)
class LimitSettings:
    """Bounds of what is accepted from one peer and offered to peers; the rest stays hidden and is reported."""

    nodes: int = setting(limits.NODES_PER_PEER_MAX, BOUND, "Nodes of one peer that are shown in the local graph.")
    topics: int = setting(
        limits.TOPICS_PER_PEER_MAX, BOUND, "Pairs of topic and node of one peer, and those that this module offers."
    )
    services: int = setting(
        limits.SERVICES_PER_PEER_MAX, BOUND, "Services of one peer, and those that this module offers."
    )
    params: int = setting(
        limits.FOLLOWED_MAX, BOUND, "Parameters that this module follows, and that one peer may follow here."
    )


@dataclass(frozen=True, slots=True)
class LaneSettings:
    """The marks of each lane's packets: DSCP (RFC 2474) for the network, SO_PRIORITY for this machine."""

    express_dscp: int = setting(
        48, DSCP, "DSCP of the express lane. 48 is CS6: Wi-Fi's voice queue, where EF would be video."
    )
    express_priority: int = setting(
        6, PACKET_PRIORITY, "SO_PRIORITY of the express lane; 6 is the first band of pfifo_fast."
    )
    bulk_dscp: int = setting(0, DSCP, "DSCP of the bulk lane.")
    bulk_priority: int = setting(0, PACKET_PRIORITY, "SO_PRIORITY of the bulk lane.")


@dataclass(frozen=True, slots=True)
class RealtimeSettings:
    """Requests to the kernel for real-time behaviour; refusals are logged."""

    enabled: bool = switch("Ask for SCHED_FIFO and locked memory.", option="--realtime/--no-realtime")
    priority: int = setting(
        50,
        whole_number(1, 99, "a priority of SCHED_FIFO"),
        "Priority of SCHED_FIFO; below 50 the kernel's interrupt threads come first.",
    )
    lock_memory: bool = switch("Keep the agent's memory in RAM (mlockall).", default=True)


@dataclass(frozen=True, slots=True)
class WebSettings:
    """Where ``rmpa web`` serves, and whether the agent starts it."""

    enabled: bool = switch("Start rmpa web with the agent, and restart it if it ends.", option="--web/--no-web")
    port: int = setting(8480, PORT, "The port of rmpa web.")
    listen: str = setting(
        "127.0.0.1", HOST, "The address that rmpa web listens at; beyond this machine clients need a token."
    )
    token_file: str = setting(
        "",
        TEXT,
        "The file of the token, made if it is missing; if set, clients on this machine need the token too.",
        shown_default="in the state directory",
    )
    hosts: tuple[str, ...] = setting(
        (), list_of(HOST), "Names of this server in URLs, besides its addresses, localhost and the host's name."
    )
    ports: tuple[int, ...] = setting(
        (), list_of(PORT), "Further ports, for clients that expect 9090 (rosbridge) or 8765 (Foxglove)."
    )
    origins: tuple[str, ...] = setting(
        (), list_of(TEXT), "Pages of other sites that may connect, such as https://app.foxglove.dev.", live=True
    )
    control: bool = switch(
        "Let clients publish, call and offer services, and set parameters; they then need the token.", live=True
    )
    cert: str = setting(
        "", TEXT, "Serve HTTPS with this certificate: a PEM file, the intermediate certificates behind it."
    )
    key: str = setting("", TEXT, "The certificate's private key: a PEM file; empty: it is in the certificate's file.")
    drive: bool = switch("Let the monitor's joystick command a robot; clients then need the token.", live=True)
    command_age_ms: int = setting(
        0,
        whole_number(0, 60_000, "milliseconds (0: any age)", "MS"),
        "Drop what rosbridge and Foxglove clients publish, call and set if it may be older than this; 0: take all.",
        live=True,
    )


_MEGABYTES: Final = whole_number(1, 1_000_000, "a number of MB", "MB")
# What keeps a recording by itself.
ALARM, PEER_LOST, NODE_DIED, CONTRACT = "alarm", "peer_lost", "node_died", "contract"


@dataclass(frozen=True, slots=True)
class RecordSettings:
    """What ``rmpa record`` keeps of the last minutes, and whether the agent starts it."""

    enabled: bool = switch(
        "Start rmpa record with the agent, and restart it if it ends.", option="--record/--no-record"
    )
    topics: tuple[str, ...] = setting(("/**",), list_of(TOPIC_GLOB), "Topics of this module's nodes to record.")
    deny: tuple[str, ...] = setting((), list_of(TOPIC_GLOB), "Topics that are not recorded.", shown_default="none")
    seconds: float | None = setting(120.0, duration_of("a duration"), "How much of the past is there to keep.")
    megabytes: int = setting(512, _MEGABYTES, "The most that the past takes on the disk, MB.")
    kept_megabytes: int = setting(
        4096, _MEGABYTES, "The most that kept recordings take, MB; the oldest that no person asked for give way."
    )
    topic_rate: int | None = setting(
        4_000_000, BYTES_A_SECOND, "The most that one topic may write; what is above it is left out, and counted."
    )
    total_rate: int | None = setting(
        None, BYTES_A_SECOND, "The most that all topics together may write; likewise.", shown_default="unlimited"
    )
    thin: float | None = setting(5.0, RATE, "Messages a second of thin_types.")
    thin_types: tuple[str, ...] = setting(
        ("sensor_msgs/*Image", "sensor_msgs/PointCloud*"), list_of(TYPE_GLOB), "Types that are thinned."
    )
    keep_on: tuple[str, ...] = setting(
        (ALARM, PEER_LOST, NODE_DIED),
        list_of(
            word_of(
                (ALARM, PEER_LOST, NODE_DIED, CONTRACT), "a reason", "it is alarm, peer_lost, node_died or contract"
            )
        ),
        "What keeps a recording, at all modules that are linked: alarm, peer_lost, node_died, contract.",
    )
    stop_topics: tuple[str, ...] = setting(
        (),
        list_of(TOPIC_GLOB),
        "Topics of emergency stops: a message (of std_msgs/Bool: true) keeps a recording.",
        shown_default="none",
    )
    after: float | None = setting(5.0, duration_of("a duration"), "How long a recording goes on behind its reason.")
    fsync: float | None = setting(
        1.0, duration_of("a duration"), "How often the disk must have it: what a power cut may take; infinite: never."
    )


@dataclass(frozen=True, slots=True)
class TrustSettings:
    """What the modules of a secured mesh may do here, and whether this agent runs without trust."""

    default: str = setting(
        "deny",
        peer_rules.PERMISSION_DEFAULT,
        "What applies where no [[permission]] matches: deny; or allow: each member of the mesh may do everything.",
        live=True,
    )
    groups: tuple[peer_rules.ModuleGroup, ...] = setting(
        (),
        peer_rules.MODULE_GROUPS,
        "Names for sets of modules, each a list of globs over modules' names.",
        shown_default="none",
        live=True,
    )
    relays: tuple[str, ...] = setting(
        (),
        list_of(PEER_GLOB),
        "Modules that may pass on what others offer; the origin that they name cannot be proved.",
        live=True,
    )
    direct: bool = switch(
        "Let nodes connect directly to those of other machines although nothing protects these connections.",
        live=True,
    )
    require: bool = switch("Refuse to start while this module has not joined a secured mesh.")
    insecure: bool = switch(
        "Start without trust although other modules here have keys; a module with its own keys is secured anyway.",
        option="--insecure",
    )
    rules: tuple[peer_rules.PermissionRule, ...] = setting(
        (),
        peer_rules.PERMISSION_RULES,
        "What other modules may do here; a deny that matches wins over an allow.",
        key="permission",
        live=True,
    )


@dataclass(frozen=True, slots=True)
class Settings:
    """All settings of one agent.

    ``config_file`` is the file that was read, if there was one; it is not a setting.
    """

    name: str = setting(
        "",
        NAME,
        "The module's name among its peers, a ROS base name.",
        option="--name",
        shown_default="the name of the first start, else from the host's name",
    )
    domain: int = setting(0, DOMAIN, "Agents join only those of the same domain, 0 to 232.", option="--domain")
    core_mode: str = setting(
        "embedded",
        word_of(
            ("embedded", "external"),
            "a kind of core",
            "embedded: the agent's own; external: a roscore that runs already",
            "MODE",
        ),
        "embedded: run the ROS core; external: use the roscore of ROS_MASTER_URI.",
        key="core.mode",
        env="RMPA_CORE",
        option="--core",
    )
    core_master: str = setting(
        "",
        MASTER_URI,
        "The external core's URI.",
        key="core.master",
        env="RMPA_MASTER",
        option="--master",
        shown_default="ROS_MASTER_URI",
    )
    core_keep: str = setting(
        "auto",
        word_of(
            ("auto", "always", "never"),
            "a choice",
            "auto: if a node of the run before still runs, or the core died; always; never: begin empty, "
            "as roscore does",
            "WHEN",
        ),
        "Restore nodes and parameters of the last run; auto: if one of its nodes still runs, or the core crashed.",
        key="core.keep",
        env="RMPA_KEEP",
        option="--keep",
    )
    core_host: str = setting(
        "127.0.0.1",
        HOST,
        "The address that the ROS core listens at; 127.0.0.1: this machine only.",
        key="core.host",
        option="--core-host",
    )
    core_port: int = setting(11311, PORT, "The ROS core's port.", key="core.port", option="--core-port")
    port: int = setting(
        0,
        whole_number(0, 65535, "a port (0: any)", "PORT"),
        "The mesh's port, TCP and UDP; 0: any free one.",
        key="mesh.port",
        option="--port",
    )
    interfaces: tuple[str, ...] = setting(
        (),
        list_of(INTERFACE),
        "Use only these network interfaces.",
        key="discovery.interfaces",
        option="--interface",
        shown_default="every usable one",
    )
    seeds: tuple[HostPort, ...] = setting(
        (),
        list_of(HOST_PORT),
        "Addresses of agents that multicast does not reach; without a port: the domain's discovery port.",
        key="discovery.seeds",
        option="--seed",
    )
    multicast: Multicast = setting(
        Multicast(),
        MULTICAST,
        "Multicast group and port of beacons; the domain is added to the port; off (false in the file): none.",
        key="discovery.multicast",
        option="--multicast",
    )
    policy: peer_rules.PolicySettings = table(peer_rules.PolicySettings, "bridge", live=True)
    transport: Transport = setting(
        DEFAULT_TRANSPORT,
        peer_rules.TRANSPORT,
        "How messages travel, unless a [[contract]] says otherwise. relay: through the agents; auto: from node to "
        "node where possible; direct: the same, with a warning where it is not possible.",
        key="bridge.transport",
        live=True,
    )
    prefix_peers: bool = switch(
        "Put each peer's name before its names here (/arm/odom of arm): for robots that use the same names.",
        key="bridge.prefix_peers",
        option="--prefix-peers",
        live=True,
    )
    rosout: bool = switch(
        "Whether /rosout crosses; both modules need it. `rmpa log` shows the log of all modules without it.",
        key="bridge.rosout",
        live=True,
    )
    peers: tuple[peer_rules.PeerRule, ...] = setting(
        (),
        peer_rules.PEER_RULES,
        "Names and rules for single peers; all that match apply, in order.",
        key="peer",
        live=True,
    )
    contracts: tuple[ContractRule, ...] = setting(
        (),
        CONTRACT_RULES,
        "What topics need; every rule that matches a topic applies, in order.",
        key="contract",
        live=True,
    )
    services: ServiceSettings = table(ServiceSettings, "services", "SERVICE", live=True)
    nodes: NodeSettings = table(NodeSettings, "nodes", "NODE", live=True)
    resources: ResourceSettings = table(ResourceSettings, "resources", "RESOURCE")
    params: ParamSettings = table(ParamSettings, "params", live=True)
    time: TimeSettings = table(TimeSettings, "time", "TIME", live=True)
    limits: LimitSettings = table(LimitSettings, "limits", "LIMIT", live=True)
    lanes: LaneSettings = table(LaneSettings, "lanes")
    realtime: RealtimeSettings = table(RealtimeSettings, "realtime", "REALTIME")
    web: WebSettings = table(WebSettings, "web", "WEB")
    record: RecordSettings = table(RecordSettings, "record", "RECORD")
    trust: TrustSettings = table(TrustSettings, "trust", "TRUST")
    gateway: GatewaySettings = table(GatewaySettings, "gateway", "GATEWAY", command="gateway")
    relay: bool = switch(
        "Offer what comes from one peer to others that do not reach it themselves.", key="relay.enabled"
    )
    control_group: str = setting(
        "",
        TEXT,
        "A group (its name or number) whose users may use the control socket, besides this user and root.",
        key="control.group",
        shown_default="none",
    )
    log_level: str = setting(
        "info",
        word_of(
            ("debug", "info", "warning", "error"),
            "a log level",
            "the levels are debug, info, warning, error",
            "LEVEL",
        ),
        "debug, info, warning or error.",
        key="log.level",
        option="--log-level",
        live=True,
    )
    log_json: bool = switch("Log one JSON object a line.", key="log.json", option="--log-json")
    runtime_dir: str = setting(
        "", TEXT, "The directory of the control sockets.", key="", shown_default="this user's runtime directory"
    )
    state_dir: str = setting(
        "", TEXT, "The directory of what is kept when rmpa restarts.", shown_default="this user's state directory"
    )
    config_file: Path | None = None

    @property
    def discovery_port(self) -> int:
        """The port of this domain's beacons."""
        return self.multicast.port + self.domain

    def make_contracts(self) -> Contracts:
        """The contracts of this module's topics, by ``[[contract]]`` and ``[bridge] transport``."""
        return Contracts(self.contracts, self.transport)

    @property
    def naming(self) -> tuple[peer_rules.PeerRule, ...]:
        """The rules for peers' names: ``[[peer]]``, and behind them the prefix that ``prefix_peers`` gives to all."""
        return (*self.peers, peer_rules.PeerRule("*", f"/{PEER}")) if self.prefix_peers else self.peers

    @property
    def allows_direct(self) -> bool:
        """Whether any topic may go from node to node, past the agents."""
        words = (self.transport, *(rule.values.get("transport") for rule in self.contracts))
        return any(word in (Transport.DIRECT, Transport.AUTO) for word in words)


# Every setting, in the order of the documentation.
SETTINGS: Final = tuple(settings_of(Settings))
# The tables of ``rmpa.toml``, each with its description; ``gateway.ros2`` is one in another.
TABLES: Final = {
    "core": "Where the ROS core listens, or which roscore is used instead of it.",
    "mesh": "The links to the peers.",
    "discovery": "How peers find each other.",
    "bridge": "Which topics may cross, by globs.",
    "services": "Which services may cross, and how long a call may take.",
    "nodes": "What peers may do with this module's nodes.",
    "resources": "Smart Resources that are started on request, from any module, and at boot.",
    "params": "What peers may do with this module's parameters.",
    "time": "Which peer's simulated time is used here, and whether peers may use this module's.",
    "limits": "How much is accepted from one peer.",
    "lanes": "How the packets of each lane are marked.",
    "realtime": "What the agent asks the kernel for.",
    "web": "Where the module's state is served over HTTP (docs/guides/web.md#rmpa-web).",
    "record": "What the flight recorder keeps (docs/guides/recording.md).",
    "trust": "What the modules of a secured mesh may do here (docs/design/trust.md).",
    "gateway": "The sites that rmpa gateway joins (docs/guides/sites.md); the options are those of rmpa gateway.",
    "gateway.ros2": "The ROS 2 graph that rmpa gateway joins (docs/guides/ros2.md).",
    "relay": "Whether this module joins networks that are not routed to each other.",
    "control": "Who on this machine may use the agent's control socket, which the commands ask.",
    "log": "Level and format of the log.",
}


def toml_value(value: object) -> str:
    """A setting's value as it stands in ``rmpa.toml``."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return f"{value:.15g}"
    if isinstance(value, tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, Multicast) and not value.enabled:
        return "false"
    return json.dumps(str(value), ensure_ascii=False)


@cache
def json_schema() -> JsonSchema:
    """The JSON Schema (draft 7) of ``rmpa.toml``; ``config.read`` checks keys and types by it."""
    root: JsonSchema = {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "rmpa.toml",
        "description": "The settings of one RMPA agent.",
        "type": "object",
        "additionalProperties": False,
        "properties": {},
    }
    for it in SETTINGS:
        inside = root["properties"]
        for depth, name in enumerate(it.key[:-1], 1):
            about = TABLES[".".join(it.key[:depth])]
            empty = {"type": "object", "description": about, "additionalProperties": False, "properties": {}}
            inside = inside.setdefault(name, empty)["properties"]
        entry = it.type.json_schema | {"description": it.help.replace("`", "")}
        if not it.is_list_of_tables and not it.shown_default and it.default != "":
            entry["default"] = json_value(it.default)
        if it.key:
            inside[it.key[-1]] = entry
    return root


def json_value(value: object) -> object:
    """A setting's value as JSON has it: addresses as text, rules as objects of the keys that they have."""
    if isinstance(value, tuple):
        return [json_value(element) for element in value]
    if isinstance(value, Multicast | HostPort):
        return str(value) if value != Multicast(enabled=False) else False
    if is_dataclass(value) and not isinstance(value, type):
        return {key: json_value(part) for key, part in asdict(value).items() if part is not None}
    return value.value if isinstance(value, StrEnum) else value


def schema_text() -> str:
    """The JSON Schema as it is printed and stands in docs/."""
    return json.dumps(json_schema(), indent=2, ensure_ascii=False) + "\n"
