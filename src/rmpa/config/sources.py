"""Where settings come from, each source stronger than the one before it.

::

    defaults < ROS environment < rmpa.toml < RMPA_* < options

The module's name has one more: the name of its first start, which the state directory keeps (``config.module_name``).
A source gives raw values and says where each was written; the types of ``config.settings`` read them. A setting that
cannot be used is a ``ConfigError`` that names that place.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from ipaddress import AddressValueError, IPv4Address
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar
from urllib.parse import urlsplit

from rmpa.config.contract_rules import contract_warnings
from rmpa.config.file import dotted, parse_config
from rmpa.config.module_name import NameFacts, choose_name
from rmpa.config.param_rules import follow_problems
from rmpa.config.peer_rules import peer_warnings
from rmpa.config.permission_rules import permission_problems
from rmpa.config.schema import REMOVED
from rmpa.config.settings import SETTINGS, Settings
from rmpa.config.state_dir import NAME_FILE, kept_name, state_dir
from rmpa.config.toml_lines import line_of
from rmpa.config.values import BadValue, did_you_mean
from rmpa.core.errors import ConfigError
from rmpa.core.identity import peer_name_from

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.config.schema import Key, Setting
    from rmpa.config.values import Place

FILE_NAME: Final = "rmpa.toml"
VARIABLES: Final = ("RMPA_CONFIG", "RMPA_AGENT", *(setting.env for setting in SETTINGS if setting.env))
"""Every environment variable of this program."""
_BY_NAME: Final = {setting.name: setting for setting in SETTINGS}


@dataclass(frozen=True, slots=True)
class Given:
    """A raw value, and where it was written.

    Args:
        raw: The value as it was written.
        source: The option, the variable, or the key of the file.
        path: The file, for a value of a file.
        text: That file's text.
        key: The key in it.
    """

    raw: object
    source: str
    path: Path | None = None
    text: str = field(default="", repr=False)
    key: Key = ()

    def read(self, setting: Setting) -> object:
        """The typed value.

        Raises:
            ConfigError: It cannot be used; the error names the place.
        """
        try:
            return setting.type.read(self.raw)
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

    def __str__(self) -> str:
        """Where it was written: ``--port``, ``RMPA_PORT``, ``/etc/rmpa/rmpa.toml:3``."""
        return self.source if self.path is None else f"{self.path}:{line_of(self.text, self.key)}"

    def _written(self, value: str) -> str:
        if self.path is not None:
            return f'"{value}"'
        return f"{self.source} {value}" if self.source.startswith("--") else value


_Layer = dict[str, Given]
"""The raw values of one source, by the setting's name."""
_Tree = dict[str, Any]
"""Values by key; those of a table are a dictionary again."""
_Table = TypeVar("_Table")


@dataclass(frozen=True, slots=True)
class Loaded:
    """Settings, and how they came to be.

    Args:
        settings: The settings.
        notes: What the user should know about them, for the log at level warning.
        given: By the setting's name: what its strongest source gives. A setting that is missing has its default.
        name_facts: What the choice of the name depends on.
    """

    settings: Settings
    notes: tuple[str, ...] = ()
    given: Mapping[str, Given] = field(default_factory=dict, repr=False)
    name_facts: NameFacts = field(default_factory=NameFacts)


def load_settings(
    options: Mapping[str, object],
    environ: Mapping[str, str],
    *,
    host_name: str,
    cwd: Path | None = None,
) -> Loaded:
    """Join all sources.

    Args:
        options: Those of the command line, as written, by ``Setting.option_name``; and ``config``, the file to read.
            ``None`` and empty tuples are options that were not given.
        environ: The environment's variables.
        host_name: This machine's name: the default for the peer's, and to tell whether ROS_MASTER_URI is local.
        cwd: Where ``rmpa.toml`` is looked for first; the working directory by default.

    Raises:
        ConfigError: A setting cannot be used, or the file that was named cannot be read.
    """
    notes: list[str] = []
    named = options.get("config")
    path = find_config_file(str(named) if named else None, environ, cwd or Path(), notes)
    from_file = _file_layer(path) if path is not None else {}
    for name, given in from_file.items():
        given.read(_BY_NAME[name])  # a mistake in the file is an error even where an option outweighs it
    from_variables, from_options = _variable_layer(environ, notes), _option_layer(options)
    said = from_file | from_variables | from_options
    external = "core_mode" in said and said["core_mode"].read(_BY_NAME["core_mode"]) == "external"
    strongest = _ros_layer(environ, host_name, notes, external=external) | said
    values = {name: given.read(_BY_NAME[name]) for name, given in strongest.items()}
    directory = state_dir(environ, str(values.get("state_dir") or ""))
    facts = NameFacts(
        option=_name_in(from_options),
        variable=_name_in(from_variables),
        file=_name_in(from_file),
        kept=kept_name(directory),
        default=peer_name_from(host_name),
    )
    values["name"] = choose_name(facts).name
    if directory is not None and facts.kept and "name" not in strongest:
        strongest["name"] = Given(facts.kept, str(directory / NAME_FILE))
    settings = _assemble(values, path)
    for name, warnings in (
        ("contracts", contract_warnings(settings.contracts)),
        ("peers", peer_warnings(settings.peers)),
    ):
        notes += [str(strongest[name].error(warning.text, "", warning.at)) for warning in warnings]
    _check_core(strongest, notes, external=external)
    _check_together(settings, strongest)
    return Loaded(settings, tuple(notes), strongest, facts)


def _name_in(layer: _Layer) -> str:
    """The module's name as one source says it; empty: it does not."""
    return str(layer["name"].read(_BY_NAME["name"])) if "name" in layer else ""


def _assemble(values: Mapping[str, object], path: Path | None) -> Settings:
    """The settings with these values, by name; those in a table (``realtime.cpus``) are set in its dataclass."""
    tree: _Tree = {}
    for name, value in values.items():
        *tables, key = name.split(".")
        inner = tree
        for table in tables:
            inner = inner.setdefault(table, {})
        inner[key] = value
    return _with(Settings(config_file=path), tree)


def _with(table: _Table, tree: _Tree) -> _Table:
    """A dataclass of settings with other values; a dictionary among them is one of its tables."""
    values = {
        key: _with(getattr(table, key), value) if isinstance(value, dict) else value for key, value in tree.items()
    }
    return replace(table, **values)  # type: ignore[type-var] # each is a dataclass, each value of its setting's type


def _check_together(settings: Settings, given: _Layer) -> None:
    """Check what single settings do not show.

    Raises:
        ConfigError: They do not fit each other.
    """
    if settings.discovery_port > 65535:
        source = given["multicast"].source if "multicast" in given else "domain"
        problem = f"port {settings.multicast.port} plus domain {settings.domain} is beyond 65535"
        raise ConfigError(source, problem, "choose a lower port")
    if (count := len(settings.params.follow)) > settings.limits.params:
        problem = f"{count} rules, more than limits.params = {settings.limits.params}"
        raise given["params.follow"].error(problem, "raise that, or follow a namespace as a whole", ())
    for at, problem, remedy in permission_problems(settings.trust.rules, settings.trust.groups):
        raise given["trust.rules"].error(problem, remedy, at)
    for name, at, problem in follow_problems(settings.params.follow, settings.time.follow, settings.name):
        raise given[name].error(problem, "name another module", at)


def find_config_file(flag: str | None, environ: Mapping[str, str], cwd: Path, notes: list[str]) -> Path | None:
    """The file to read: the one that was named, or else the first that exists; ``None`` if there is none.

    Args:
        flag: The path after ``--config``.
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


def _file_layer(path: Path) -> _Layer:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError("the file", f"cannot be read: {error.strerror}", "", path) from None
    found = parse_config(data, path)
    text = data.decode("utf-8-sig")
    return {
        setting.name: Given(found[setting.key], ".".join(setting.key), path, text, setting.key)
        for setting in SETTINGS
        if setting.key in found
    }


def _variable_layer(environ: Mapping[str, str], notes: list[str]) -> _Layer:
    for variable in sorted(environ):
        if variable in REMOVED:
            raise ConfigError(variable, "is not a variable any more", REMOVED[variable])
        if variable.startswith("RMPA_") and variable not in VARIABLES:
            near = did_you_mean(variable, VARIABLES)
            notes.append(f"{variable} is not a variable of ours" + (f"; did you mean {near}?" if near else ""))
    return {
        setting.name: Given(environ[setting.env], setting.env) for setting in SETTINGS if environ.get(setting.env)
    }


def _option_layer(options: Mapping[str, object]) -> _Layer:
    return {
        setting.name: Given(raw, setting.flag)
        for setting in SETTINGS
        if setting.option and (raw := options.get(setting.option_name)) not in (None, ())
    }


def _check_core(strongest: _Layer, notes: list[str], *, external: bool) -> None:
    """Check that settings of one kind of core are not given for the other.

    Raises:
        ConfigError: An external core's URI is given, but the core is embedded.
    """
    if not external and "core_master" in strongest:
        raise strongest["core_master"].error(
            "is of no use with the embedded core", "say also that the core is external (--core external)", ()
        )
    embedded_only = ("core_host", "core_port", "core_keep")
    given_here = [strongest[name] for name in embedded_only if external and name in strongest]
    useless = [given for given in given_here if given.path is None]  # a file may be written for both
    notes += [str(given.error("is of no use with an external core", "", ())) for given in useless]


def _ros_layer(environ: Mapping[str, str], host_name: str, notes: list[str], *, external: bool) -> _Layer:
    layer: _Layer = {}
    if environ.get("ROS_DOMAIN_ID"):
        layer["domain"] = Given(environ["ROS_DOMAIN_ID"], "ROS_DOMAIN_ID")
    reach = environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper()
    known = ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")
    if reach and reach not in known:
        near = did_you_mean(reach, known)
        remedy = f"did you mean {near}?" if near else f"it is one of {', '.join(known)}"
        raise ConfigError("ROS_AUTOMATIC_DISCOVERY_RANGE", f"{reach!r} is not a range", remedy)
    if reach == "OFF":
        layer["multicast"] = Given(False, "ROS_AUTOMATIC_DISCOVERY_RANGE")
    elif reach == "LOCALHOST":
        layer["interfaces"] = Given(["lo"], "ROS_AUTOMATIC_DISCOVERY_RANGE")
    static = environ.get("ROS_STATIC_PEERS", "")
    if static and reach == "OFF":
        notes.append("ROS_STATIC_PEERS is ignored, as in ROS 2: ROS_AUTOMATIC_DISCOVERY_RANGE is OFF")
    elif static:
        layer["seeds"] = Given([p.strip() for p in static.split(";") if p.strip()], "ROS_STATIC_PEERS")
    uri = environ.get("ROS_MASTER_URI", "")
    if uri and external:
        layer["core_master"] = Given(uri, "ROS_MASTER_URI")
    elif uri:
        port = _local_master_port(uri, environ, host_name, notes)
        if port is not None:
            layer["core_port"] = Given(port, "ROS_MASTER_URI")
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
