"""Where settings come from, each source stronger than the one before it.

::

    defaults < ROS environment < rmpa.toml < RMPA_* < flags

Every source gives raw values with the place where they were written; ``config.values`` reads them. A
setting that cannot be used is a ``ConfigError`` that names that place.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from ipaddress import AddressValueError, IPv4Address
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from rmpa.config import values
from rmpa.config.contract_rules import ContractRules, read_contracts
from rmpa.config.file import Key, Place, dotted, line_of, parse_config
from rmpa.config.param_rules import problems, read_follow_rules, read_key_glob
from rmpa.config.peer_rules import PeerRules, read_peers
from rmpa.config.service_rules import read_node_glob, read_service_glob, read_service_rules, read_timeout
from rmpa.config.settings import (
    LaneSettings,
    LimitSettings,
    NodeSettings,
    ParamSettings,
    PolicySettings,
    RealtimeSettings,
    ServiceSettings,
    Settings,
    TimeSettings,
)
from rmpa.config.values import BadValue, Multicast
from rmpa.core.errors import ConfigError
from rmpa.core.identity import peer_name_from

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

FILE_NAME: Final = "rmpa.toml"


@dataclass(frozen=True, slots=True)
class Flags:
    """What the command line says, as written; ``None`` and empty tuples are flags that were not given."""

    name: str | None = None
    core_host: str | None = None
    core_port: str | None = None
    core_mode: str | None = None
    core_master: str | None = None
    port: str | None = None
    domain: str | None = None
    interfaces: tuple[str, ...] = ()
    seeds: tuple[str, ...] = ()
    multicast: str | None = None
    config: str | None = None
    log_level: str | None = None
    log_json: bool | None = None
    realtime: bool | None = None
    core_fresh: bool | None = None


@dataclass(frozen=True, slots=True)
class Loaded:
    """Settings, and what the user should know about how they came to be (for the log, at warning)."""

    settings: Settings
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Option:
    """One setting: how it is read, and its name in each source."""

    read: Callable[[object], object]
    key: Key = ()
    variable: str = ""
    flag: str = ""
    flag_field: str = ""


def _list_of(item: Callable[[object], object]) -> Callable[[object], object]:
    return lambda raw: values.read_list(raw, item)


_OPTIONS: Final[Mapping[str, _Option]] = {
    "name": _Option(values.read_name, ("name",), "RMPA_NAME", "--name", "name"),
    "domain": _Option(values.read_domain, ("domain",), "RMPA_DOMAIN", "--domain", "domain"),
    "core_host": _Option(values.read_host, ("core", "host"), "RMPA_CORE_HOST", "--core-host", "core_host"),
    "core_port": _Option(values.read_port, ("core", "port"), "RMPA_CORE_PORT", "--core-port", "core_port"),
    "core_mode": _Option(values.read_core_mode, ("core", "mode"), "RMPA_CORE", "--core", "core_mode"),
    "core_master": _Option(values.read_master_uri, ("core", "master"), "RMPA_MASTER", "--master", "core_master"),
    "core_fresh": _Option(values.read_bool, ("core", "fresh"), "RMPA_FRESH", "--fresh", "core_fresh"),
    "port": _Option(values.read_port_or_any, ("mesh", "port"), "RMPA_PORT", "--port", "port"),
    "interfaces": _Option(
        _list_of(values.read_interface), ("discovery", "interfaces"), "RMPA_INTERFACES", "--interface", "interfaces"
    ),
    "seeds": _Option(_list_of(values.read_host_port), ("discovery", "seeds"), "RMPA_SEEDS", "--seed", "seeds"),
    "multicast": _Option(
        values.read_multicast, ("discovery", "multicast"), "RMPA_MULTICAST", "--multicast", "multicast"
    ),
    "allow": _Option(_list_of(values.read_topic_glob), ("bridge", "allow"), "RMPA_ALLOW"),
    "deny": _Option(_list_of(values.read_topic_glob), ("bridge", "deny"), "RMPA_DENY"),
    "allow_types": _Option(_list_of(values.read_type_glob), ("bridge", "allow_types"), "RMPA_ALLOW_TYPES"),
    "deny_types": _Option(_list_of(values.read_type_glob), ("bridge", "deny_types"), "RMPA_DENY_TYPES"),
    "contracts": _Option(read_contracts, ("contract",)),
    "peers": _Option(read_peers, ("peer",)),
    "service_allow": _Option(_list_of(read_service_glob), ("services", "allow"), "RMPA_SERVICE_ALLOW"),
    "service_deny": _Option(_list_of(read_service_glob), ("services", "deny"), "RMPA_SERVICE_DENY"),
    "service_loggers": _Option(values.read_bool, ("services", "loggers"), "RMPA_SERVICE_LOGGERS"),
    "service_timeout": _Option(read_timeout, ("services", "timeout"), "RMPA_SERVICE_TIMEOUT"),
    "service_rules": _Option(read_service_rules, ("service",)),
    "node_kill": _Option(_list_of(read_node_glob), ("nodes", "kill"), "RMPA_NODE_KILL"),
    "remote_get": _Option(_list_of(read_key_glob), ("params", "remote_get"), "RMPA_REMOTE_GET"),
    "remote_set": _Option(_list_of(read_key_glob), ("params", "remote_set"), "RMPA_REMOTE_SET"),
    "follow": _Option(read_follow_rules, ("param",)),
    "time_follow": _Option(values.read_name_or_none, ("time", "follow"), "RMPA_TIME_FOLLOW"),
    "time_share": _Option(values.read_bool, ("time", "share"), "RMPA_TIME_SHARE"),
    "limit_nodes": _Option(values.read_bound, ("limits", "nodes"), "RMPA_LIMIT_NODES"),
    "limit_topics": _Option(values.read_bound, ("limits", "topics"), "RMPA_LIMIT_TOPICS"),
    "limit_services": _Option(values.read_bound, ("limits", "services"), "RMPA_LIMIT_SERVICES"),
    "limit_params": _Option(values.read_bound, ("limits", "params"), "RMPA_LIMIT_PARAMS"),
    "express_dscp": _Option(values.read_dscp, ("lanes", "express_dscp"), "RMPA_EXPRESS_DSCP"),
    "express_priority": _Option(values.read_packet_priority, ("lanes", "express_priority"), "RMPA_EXPRESS_PRIORITY"),
    "bulk_dscp": _Option(values.read_dscp, ("lanes", "bulk_dscp"), "RMPA_BULK_DSCP"),
    "bulk_priority": _Option(values.read_packet_priority, ("lanes", "bulk_priority"), "RMPA_BULK_PRIORITY"),
    "realtime": _Option(values.read_bool, ("realtime", "enabled"), "RMPA_REALTIME", "--realtime", "realtime"),
    "realtime_priority": _Option(values.read_realtime_priority, ("realtime", "priority"), "RMPA_REALTIME_PRIORITY"),
    "realtime_cpus": _Option(_list_of(values.read_cpu), ("realtime", "cpus"), "RMPA_REALTIME_CPUS"),
    "lock_memory": _Option(values.read_bool, ("realtime", "lock_memory"), "RMPA_REALTIME_LOCK_MEMORY"),
    "keep_awake": _Option(values.read_bool, ("realtime", "keep_awake"), "RMPA_REALTIME_KEEP_AWAKE"),
    "relay": _Option(values.read_bool, ("relay", "enabled"), "RMPA_RELAY"),
    "log_level": _Option(values.read_level, ("log", "level"), "RMPA_LOG_LEVEL", "--log-level", "log_level"),
    "log_json": _Option(values.read_bool, ("log", "json"), "RMPA_LOG_JSON", "--log-json", "log_json"),
    "runtime_dir": _Option(values.read_text, variable="RMPA_RUNTIME_DIR"),
    "state_dir": _Option(values.read_text, variable="RMPA_STATE_DIR"),
}
VARIABLES: Final = ("RMPA_CONFIG", "RMPA_AGENT", *(o.variable for o in _OPTIONS.values() if o.variable))
"""Every variable of ours."""


@dataclass(frozen=True, slots=True)
class _Given:
    """A raw value and where it was written; ``text`` is the file's, for a value of a file."""

    raw: object
    source: str
    path: Path | None = None
    text: str = field(default="", repr=False)
    key: Key = ()

    def read(self, option: _Option) -> object:
        """Read it, or say what is wrong and where."""
        try:
            return option.read(self.raw)
        except BadValue as error:
            remedy = error.remedy
            if error.better is not None:
                remedy = f"{remedy}; " if remedy else ""
                remedy += f"did you mean {self._written(error.better)}?"
            raise self.error(error.problem, remedy, error.at) from None

    def error(self, problem: str, remedy: str, at: Place) -> ConfigError:
        """The error that says where it was written; ``at`` is the place inside of the value."""
        if self.path is None:
            return ConfigError(self.source, problem, remedy)
        place = (*self.key, *at)
        return ConfigError(dotted(place), problem, remedy, self.path, line_of(self.text, place))

    def _written(self, value: str) -> str:
        if self.path is not None:
            return f'"{value}"'
        return f"{self.source} {value}" if self.source.startswith("--") else value


_Layer = dict[str, _Given]


def load_settings(
    flags: Flags,
    environ: Mapping[str, str],
    *,
    host_name: str,
    cwd: Path | None = None,
) -> Loaded:
    """Join all sources.

    Args:
        flags: The command line's.
        environ: The environment's variables.
        host_name: This machine's name: the default for the peer's, and to tell whether ROS_MASTER_URI is local.
        cwd: Where ``rmpa.toml`` is looked for first; the working directory by default.

    Raises:
        ConfigError: A setting cannot be used, or the file that was named cannot be read.
    """
    notes: list[str] = []
    path = find_config_file(flags.config, environ, cwd or Path(), notes)
    file_layer = _file_layer(path) if path is not None else {}
    for name, given in file_layer.items():
        given.read(_OPTIONS[name])  # a mistake in the file is told even where a flag outweighs it
    said = file_layer | _variable_layer(environ, notes) | _flag_layer(flags)
    external = "core_mode" in said and said["core_mode"].read(_OPTIONS["core_mode"]) == "external"
    strongest = _ros_layer(environ, host_name, notes, external=external) | said
    chosen = {name: given.read(_OPTIONS[name]) for name, given in strongest.items()}
    chosen.setdefault("name", peer_name_from(host_name))
    rules = chosen.pop("contracts", ContractRules())
    assert isinstance(rules, ContractRules)  # noqa: S101 - what its reader returns
    notes += [str(strongest["contracts"].error(doubt.text, "", doubt.at)) for doubt in rules.doubts]
    peers = chosen.pop("peers", PeerRules())
    assert isinstance(peers, PeerRules)  # noqa: S101 - what its reader returns
    notes += [str(strongest["peers"].error(doubt.text, "", doubt.at)) for doubt in peers.doubts]
    chosen["peers"] = peers.rules
    settings = _assemble(chosen, rules, path)
    _check_core(strongest, notes, external=external)
    if settings.discovery_port > 65535:
        source = strongest["multicast"].source if "multicast" in strongest else "domain"
        problem = f"port {settings.group_port} plus domain {settings.domain} is beyond 65535"
        raise ConfigError(source, problem, "choose a lower port")
    if (count := len(settings.params.follow)) > settings.limits.params:
        problem = f"{count} rules, more than limits.params = {settings.limits.params}"
        raise strongest["follow"].error(problem, "raise that, or follow a namespace as a whole", ())
    for name, at, problem in problems(settings.params.follow, settings.time.follow, settings.name):
        raise strongest[name].error(problem, "name another module", at)
    return Loaded(settings, tuple(notes))


def find_config_file(flag: str | None, environ: Mapping[str, str], cwd: Path, notes: list[str]) -> Path | None:
    """The file to read: the one that was named, or the first that is there, or ``None``.

    Args:
        flag: The command line's word.
        environ: The environment's variables.
        cwd: Where to look first.
        notes: Gets a line for each place that this user may not look into; it counts as empty.

    Raises:
        ConfigError: A file was named and is not there.
    """
    for source, named in (("--config", flag), ("RMPA_CONFIG", environ.get("RMPA_CONFIG"))):
        if named:
            return _named_file(named, source)
    config_home = environ.get("XDG_CONFIG_HOME") or (f"{environ['HOME']}/.config" if environ.get("HOME") else "")
    places = [cwd / FILE_NAME]
    if config_home:
        places.append(Path(config_home) / "rmpa" / FILE_NAME)
    places.append(Path("/etc/rmpa") / FILE_NAME)
    for place in places:
        try:
            if place.is_file():
                return place
        except OSError as error:
            notes.append(f"{place} is not looked for: {error.strerror}")
    return None


def _named_file(named: str, source: str) -> Path:
    try:
        path = Path(named).expanduser()
        if path.is_file():
            return path
        problem = "is a directory" if path.is_dir() else "no such file"
    except OSError as error:
        problem = error.strerror or str(error)
    except RuntimeError:
        problem = "there is no such home"
    raise ConfigError(source, f"{named}: {problem}", "name a file in TOML, like examples/rmpa.toml")


_GROUPS: Final[Mapping[str, tuple[Callable[..., object], Mapping[str, str]]]] = {
    "policy": (PolicySettings, {key: key for key in ("allow", "deny", "allow_types", "deny_types")}),
    "services": (
        ServiceSettings,
        {f"service_{key}": key for key in ("allow", "deny", "loggers", "timeout", "rules")},
    ),
    "nodes": (NodeSettings, {"node_kill": "kill"}),
    "params": (ParamSettings, {key: key for key in ("remote_get", "remote_set", "follow")}),
    "limits": (LimitSettings, {f"limit_{key}": key for key in ("nodes", "topics", "services", "params")}),
    "time": (TimeSettings, {"time_follow": "follow", "time_share": "share"}),
    "lanes": (
        LaneSettings,
        {key: key for key in ("express_dscp", "express_priority", "bulk_dscp", "bulk_priority")},
    ),
    "realtime": (
        RealtimeSettings,
        {
            "realtime": "enabled",
            "realtime_priority": "priority",
            "realtime_cpus": "cpus",
            "lock_memory": "lock_memory",
            "keep_awake": "keep_awake",
        },
    ),
}
"""Settings within settings: their class, and their fields by the names of ``_OPTIONS``."""


def _assemble(chosen: dict[str, object], rules: ContractRules, path: Path | None) -> Settings:
    multicast = chosen.pop("multicast", Multicast())
    assert isinstance(multicast, Multicast)  # noqa: S101 - what its reader returns
    groups = {
        group: settings(**{name: chosen.pop(option) for option, name in names.items() if option in chosen})
        for group, (settings, names) in _GROUPS.items()
    }
    return Settings(
        **chosen,  # type: ignore[arg-type] # each value came from the reader that its name has in _OPTIONS
        **groups,  # type: ignore[arg-type] # likewise
        contracts=rules.rules,
        group=multicast.group,
        group_port=multicast.port,
        multicast=multicast.enabled,
        config_file=path,
    )


def _file_layer(path: Path) -> _Layer:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError("the file", f"cannot be read: {error.strerror}", "", path) from None
    found = parse_config(data, path)
    text = data.decode("utf-8-sig")
    return {
        name: _Given(found[option.key], ".".join(option.key), path, text, option.key)
        for name, option in _OPTIONS.items()
        if option.key in found
    }


def _variable_layer(environ: Mapping[str, str], notes: list[str]) -> _Layer:
    for variable in sorted(environ):
        if variable.startswith("RMPA_") and variable not in VARIABLES:
            near = values.did_you_mean(variable, VARIABLES)
            notes.append(f"{variable} is not a variable of ours" + (f"; did you mean {near}?" if near else ""))
    return {
        name: _Given(environ[option.variable], option.variable)
        for name, option in _OPTIONS.items()
        if environ.get(option.variable)
    }


def _flag_layer(flags: Flags) -> _Layer:
    layer: _Layer = {}
    for name, option in _OPTIONS.items():
        raw = getattr(flags, option.flag_field) if option.flag_field else None
        if raw is not None and raw != ():
            layer[name] = _Given(raw, option.flag)
    return layer


def _check_core(strongest: _Layer, notes: list[str], *, external: bool) -> None:
    """Settings of the one kind of core say nothing about the other."""
    if not external and "core_master" in strongest:
        raise strongest["core_master"].error(
            "is of no use with the embedded core", "say also that the core is external (--core external)", ()
        )
    embedded_only = ("core_host", "core_port", "core_fresh")
    given_here = [strongest[name] for name in embedded_only if external and name in strongest]
    useless = [given for given in given_here if given.path is None]  # a file may be written for both
    notes += [str(given.error("is of no use with an external core", "", ())) for given in useless]


def _ros_layer(environ: Mapping[str, str], host_name: str, notes: list[str], *, external: bool) -> _Layer:
    layer: _Layer = {}
    if environ.get("ROS_DOMAIN_ID"):
        layer["domain"] = _Given(environ["ROS_DOMAIN_ID"], "ROS_DOMAIN_ID")
    reach = environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper()
    known = ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")
    if reach and reach not in known:
        near = values.did_you_mean(reach, known)
        remedy = f"did you mean {near}?" if near else f"it is one of {', '.join(known)}"
        raise ConfigError("ROS_AUTOMATIC_DISCOVERY_RANGE", f"{reach!r} is not a range", remedy)
    if reach == "OFF":
        layer["multicast"] = _Given(False, "ROS_AUTOMATIC_DISCOVERY_RANGE")
    elif reach == "LOCALHOST":
        layer["interfaces"] = _Given(["lo"], "ROS_AUTOMATIC_DISCOVERY_RANGE")
    static = environ.get("ROS_STATIC_PEERS", "")
    if static and reach == "OFF":
        notes.append("ROS_STATIC_PEERS is ignored, as in ROS 2: ROS_AUTOMATIC_DISCOVERY_RANGE is OFF")
    elif static:
        layer["seeds"] = _Given([p.strip() for p in static.split(";") if p.strip()], "ROS_STATIC_PEERS")
    uri = environ.get("ROS_MASTER_URI", "")
    if uri and external:
        layer["core_master"] = _Given(uri, "ROS_MASTER_URI")
    elif uri:
        port = _local_master_port(uri, environ, host_name, notes)
        if port is not None:
            layer["core_port"] = _Given(port, "ROS_MASTER_URI")
    return layer


def _local_master_port(uri: str, environ: Mapping[str, str], host_name: str, notes: list[str]) -> int | None:
    """The port of ROS_MASTER_URI where its host is this machine."""
    parts = urlsplit(uri) if "://" in uri else None
    try:
        host, port = (parts.hostname, parts.port) if parts else (None, None)
    except ValueError:
        host, port = None, None
    if not host or port is None:
        notes.append(f"ROS_MASTER_URI={uri} is ignored: one looks like http://localhost:11311")
        return None
    own = {"localhost", host_name.lower(), host_name.partition(".")[0].lower()}
    own |= {environ[name].lower() for name in ("ROS_HOSTNAME", "ROS_IP") if environ.get(name)}
    try:
        local = IPv4Address(host).is_loopback or host in own
    except AddressValueError:
        local = host in own
    if not local:
        notes.append(f"ROS_MASTER_URI={uri} names another machine and is ignored: this one gets a core of its own")
    return port if local else None
