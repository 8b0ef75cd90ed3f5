"""Reads the settings: from ``rmpa.toml``, the environment and options, each value with its source and line."""

from __future__ import annotations

from dataclasses import dataclass, field
from ipaddress import AddressValueError, IPv4Address
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from rmpa.config.module_name import NAME_FILE, NameSource, choose_name, kept_name, state_dir
from rmpa.config.peer_rules import peer_warnings, permission_problems
from rmpa.config.rules import contract_warnings
from rmpa.config.settings import SETTINGS, Settings, json_schema
from rmpa.config.toml_file import check_writers, dotted, line_of, read_toml, value_at
from rmpa.config.values import BadValue, Place, did_you_mean, suggestion
from rmpa.core.errors import ConfigError
from rmpa.core.identity import peer_name_from

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from rmpa.config.schema import Key, Setting


# Where settings come from, each source stronger than the one before it::
#
#     defaults < ROS environment < rmpa.toml < RMPA_* < options
#
# The module's name has one more: the name of its first start, which the state directory keeps
# (``config.module_name``). A source gives raw values and says where each was written; the types of
# ``config.settings`` read them. A setting that cannot be used is a ``ConfigError`` that names that place.


FILE_NAME: Final = "rmpa.toml"
# Every environment variable of this program.
VARIABLES: Final = ("RMPA_CONFIG", "RMPA_AGENT", *(setting.env for setting in SETTINGS if setting.env))
# What each setting gives up that turns a protection off: said wherever it is true.
INSECURE: Final = {
    "trust.insecure": "true: a module without keys starts open, also beside keys of other modules",
    "gateway.insecure": "true: endpoints beyond this machine may be plain, and any program there reads and writes",
}
# The safer value of settings that protect: it is said where the file has it and a variable or option outweighs it.
_SAFER: Final = {"trust.require": True, "trust.default": "deny", "trust.direct": False}
_BY_NAME: Final = {setting.name: setting for setting in SETTINGS}


@dataclass(frozen=True, slots=True)
class Given:
    """A raw value of a setting, and where it was written.

    Attributes:
        setting: The setting.
        raw: The value as it was written.
        source: The option, the variable, or the key of the file.
        path: The file, for a value of a file.
        text: That file's text.
    """

    setting: Setting
    raw: object
    source: str
    path: Path | None = None
    text: str = field(default="", repr=False)

    def read(self) -> object:
        """The typed value.

        Raises:
            ConfigError: It cannot be used; the error names the place.
        """
        try:
            return self.setting.type.read(self.raw)
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
        place = (*self.setting.key, *at)
        return ConfigError(dotted(place), problem, remedy, self.path, line_of(self.text, place))

    def __str__(self) -> str:
        """Where it was written: ``--port``, ``RMPA_PORT``, ``/etc/rmpa/rmpa.toml:3``."""
        return self.source if self.path is None else f"{self.path}:{line_of(self.text, self.setting.key)}"

    def _written(self, value: str) -> str:
        if self.path is not None:
            return f'"{value}"'
        return f"{self.source} {value}" if self.source.startswith("--") else value


# The raw values of one source, by the setting's name.
_Layer = dict[str, Given]


@dataclass(frozen=True, slots=True)
class Loaded:
    """Settings, and how they came to be.

    Attributes:
        settings: The settings.
        notes: What the user should know about them, for the log at level warning.
        given: By the setting's name: what its strongest source gives. A setting that is missing has its default.
        names: The module's name as each source has it; empty: that one has none.
    """

    settings: Settings
    notes: tuple[str, ...] = ()
    given: Mapping[str, Given] = field(default_factory=dict, repr=False)
    names: Mapping[NameSource, str] = field(default_factory=dict)


def parse_config(data: bytes, path: Path | None) -> dict[Key, object]:
    """Read a file's bytes.

    Args:
        data: UTF-8 text in TOML.
        path: For the text of errors.

    Returns:
        What it says, by the key of a setting; only the keys and types are checked.

    Raises:
        ConfigError: With line and key, if the text is not TOML, has an unknown key or a value of a wrong type.
    """
    _, table = read_toml(data, path, json_schema())
    found = {setting.key: value_at(table, setting.key) for setting in SETTINGS if setting.key}
    return {key: value for key, value in found.items() if value is not None}


def load_settings(
    options: Mapping[str, object], environ: Mapping[str, str], *, host_name: str, cwd: Path | None = None
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
    from_file = _file_layer(path, environ) if path is not None else {}
    for given in from_file.values():
        given.read()  # a mistake in the file is an error even where an option outweighs it
    from_variables, from_options = _variable_layer(environ, notes), _option_layer(options)
    said = from_file | from_variables | from_options
    external = "core_mode" in said and said["core_mode"].read() == "external"
    strongest = ros_layer(environ, host_name, notes, external=external) | said
    values = {name: given.read() for name, given in strongest.items()}
    directory = state_dir(environ, str(values.get("state_dir") or ""))
    names = {
        NameSource.OPTION: _name_in(from_options),
        NameSource.VARIABLE: _name_in(from_variables),
        NameSource.FILE: _name_in(from_file),
        NameSource.KEPT: kept_name(directory),
        NameSource.DEFAULT: peer_name_from(host_name),
    }
    values["name"] = choose_name(names).name
    if directory is not None and names[NameSource.KEPT] and "name" not in strongest:
        strongest["name"] = Given(_BY_NAME["name"], names[NameSource.KEPT], str(directory / NAME_FILE))
    settings = Settings(config_file=path)
    for name, value in values.items():
        settings = _BY_NAME[name].put(settings, value)
    for name, warnings in (
        ("contracts", contract_warnings(settings.contracts)),
        ("peers", peer_warnings(settings.peers)),
    ):
        notes += [str(strongest[name].error(text, "", at)) for at, text in warnings]
    notes += [str(strongest[name].error(text, "", ())) for name, text in _insecure(settings, strongest, from_file)]
    _check_core(strongest, notes, external=external)
    _check_together(settings, strongest)
    return Loaded(settings, tuple(notes), strongest, names)


def _insecure(settings: Settings, strongest: _Layer, from_file: _Layer) -> Iterator[tuple[str, str]]:
    """The settings that turn a protection off, each with what it gives up."""
    if settings.trust.insecure:
        yield "trust.insecure", INSECURE["trust.insecure"]
    if settings.gateway.insecure and (settings.gateway.connect or settings.gateway.listen):
        yield "gateway.insecure", INSECURE["gateway.insecure"]
    for name, safer in _SAFER.items():
        if name in from_file and from_file[name].read() == safer != strongest[name].read():
            yield name, f"less secure than {from_file[name]}, which it outweighs"


def _name_in(layer: _Layer) -> str:
    """The module's name as one source says it; empty: it does not."""
    return str(layer["name"].read()) if "name" in layer else ""


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
    own = f"{settings.name} is this module itself; its own"
    for index, rule in enumerate(settings.params.follow):
        if rule.owner == settings.name:
            problem = f"{own} parameters are here already"
            raise given["params.follow"].error(problem, "name another module", (index, "from"))
    if settings.time.follow == settings.name:
        raise given["time.follow"].error(f"{own} time is here already", "name another module", ())


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
    raise ConfigError(
        source, f"{named}: {problem}", "name a file in TOML (docs/reference/settings.md)", code="unreadable-settings"
    )


def _file_layer(path: Path, environ: Mapping[str, str]) -> _Layer:
    try:
        check_writers(path, environ, "the file")
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(
            "the file", f"cannot be read: {error.strerror}", "", path, code="unreadable-settings"
        ) from None
    found = parse_config(data, path)
    text = data.decode("utf-8-sig")
    return {
        setting.name: Given(setting, found[setting.key], ".".join(setting.key), path, text)
        for setting in SETTINGS
        if setting.key in found
    }


def _variable_layer(environ: Mapping[str, str], notes: list[str]) -> _Layer:
    for variable in sorted(environ):
        if variable.startswith("RMPA_") and variable not in VARIABLES:
            near = did_you_mean(variable, VARIABLES)
            notes.append(f"{variable} is not a variable of ours" + (f"; did you mean {near}?" if near else ""))
    return {
        setting.name: Given(setting, environ[setting.env], setting.env)
        for setting in SETTINGS
        if environ.get(setting.env)
    }


def _option_layer(options: Mapping[str, object]) -> _Layer:
    return {
        setting.name: Given(setting, raw, setting.flag)
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


def ros_layer(environ: Mapping[str, str], host_name: str, notes: list[str], *, external: bool) -> dict[str, Given]:
    """What the ROS environment gives, by the setting's name.

    Args:
        environ: The environment's variables.
        host_name: This machine's name.
        notes: Gets a line for each variable that is ignored.
        external: Whether the core is an external one.

    Raises:
        ConfigError: A variable cannot be used.
    """
    found: dict[str, tuple[object, str]] = {}
    if environ.get("ROS_DOMAIN_ID"):
        found["domain"] = (environ["ROS_DOMAIN_ID"], "ROS_DOMAIN_ID")
    reach = environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper()
    known = ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")
    if reach and reach not in known:
        remedy = suggestion(reach, known, f"it is one of {', '.join(known)}")
        raise ConfigError("ROS_AUTOMATIC_DISCOVERY_RANGE", f"{reach!r} is not a range", remedy)
    if reach == "OFF":
        found["multicast"] = (False, "ROS_AUTOMATIC_DISCOVERY_RANGE")
    elif reach == "LOCALHOST":
        found["interfaces"] = (["lo"], "ROS_AUTOMATIC_DISCOVERY_RANGE")
    static = environ.get("ROS_STATIC_PEERS", "")
    if static and reach == "OFF":
        notes.append("ROS_STATIC_PEERS is ignored, as in ROS 2: ROS_AUTOMATIC_DISCOVERY_RANGE is OFF")
    elif static:
        found["seeds"] = ([p.strip() for p in static.split(";") if p.strip()], "ROS_STATIC_PEERS")
    uri = environ.get("ROS_MASTER_URI", "")
    if uri and external:
        found["core_master"] = (uri, "ROS_MASTER_URI")
    elif uri:
        port = _local_master_port(uri, environ, host_name, notes)
        if port is not None:
            found["core_port"] = (port, "ROS_MASTER_URI")
    return {name: Given(_BY_NAME[name], raw, source) for name, (raw, source) in found.items()}


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
