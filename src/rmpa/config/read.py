"""Reads the settings: from ``rmpa.toml``, the environment and options, each value with its source and line.

The file ``rmpa.toml``: parsed, and its shape checked against the settings that ``config.settings`` declares.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, field, replace
from ipaddress import AddressValueError, IPv4Address
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar
from urllib.parse import urlsplit

from rmpa.config import limits
from rmpa.config.module_name import NAME_FILE, NameFacts, choose_name, kept_name, state_dir
from rmpa.config.peer_rules import peer_warnings, permission_problems
from rmpa.config.rules import contract_warnings, follow_problems
from rmpa.config.schema import REMOVED
from rmpa.config.settings import SETTINGS, Settings
from rmpa.config.values import BadValue, JsonSchema, Place, did_you_mean, shown
from rmpa.core.errors import ConfigError
from rmpa.core.identity import peer_name_from

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from rmpa.config.schema import Key, Setting


# Where in a TOML text a key or an element stands: ``tomllib`` does not say.


def value_at(table: object, place: Place) -> object:
    """The value at a place of a parsed file; ``None`` if there is none."""
    for part in place:
        in_table = isinstance(table, dict) and part in table
        in_list = isinstance(table, list) and isinstance(part, int) and part < len(table)
        if not in_table and not in_list:
            return None
        table = table[part]  # type: ignore[index] # one of the two, as just seen
    return table


def line_of(text: str, place: Place) -> int | None:
    """The line, from 1, on which the key or element at a place begins in a valid TOML text; ``None`` if it has none.

    A prefix of whole lines is valid TOML only if no statement is left open. So the first valid prefix that contains
    the place ends with its statement, and the last valid prefix before that ends where the statement begins. An
    element of a list is searched within its statement.
    """
    lines = text.split("\n")
    begin = 0
    for end in range(1, len(lines) + 1):
        try:
            table = tomllib.loads("\n".join(lines[:end]))
        except (ValueError, RecursionError):
            continue
        if value_at(table, place) is not None:
            return _element_line(lines, begin, end, place)
        begin = end
    return None


def _element_line(lines: list[str], begin: int, end: int, place: Place) -> int:
    """The line of a place in the statement between two lines: not its first only for an element of a list."""
    if begin + 1 == end:
        return end
    inline = value_at(tomllib.loads("\n".join(lines[begin:end])), place) is not None
    indices = [part for part in (place if inline else place[-1:]) if isinstance(part, int)]
    if not indices:
        return begin + 1
    for stop in range(begin + 1, end):
        try:
            value: object = tomllib.loads("\n".join(lines[begin:stop]) + "\n]")
        except ValueError:
            continue
        while isinstance(value, dict) and value:
            value = next(iter(value.values()))
        if isinstance(value, list) and len(value) > indices[0]:
            return stop
    return end


_AT_LINE: Final = re.compile(r" \(at line (\d+), column \d+\)$")
_TYPES: Final[dict[str, tuple[type, str]]] = {
    "string": (str, "a text in quotes"),
    "integer": (int, "a whole number"),
    "boolean": (bool, "true or false"),
    "array": (list, "a list"),
    "object": (dict, "a table"),
}
"""By the name of a type in JSON Schema: the type of TOML values, and its name in errors."""
SCHEMAS: Final[dict[Key, JsonSchema]] = {s.key: s.type.json_schema for s in SETTINGS if s.key}
"""Every key that a file may have, ``("name",)``, ``("core", "port")`` and so on, and what its value may be.

Each of ``LISTS`` is one: ``("contract",)`` has the list of all ``[[contract]]``.
"""
LISTS: Final = {s.key: tuple(s.type.json_schema["items"]["properties"]) for s in SETTINGS if s.is_list_of_tables}
"""The tables that there may be many of (``("contract",)``), and the keys that each may have."""
_TABLES: Final = {
    key[:depth]: tuple(dict.fromkeys(other[depth] for other in SCHEMAS if other[:depth] == key[:depth]))
    for key in SCHEMAS
    for depth in range(len(key))
}
"""The keys and tables of each table; those of the file itself by ``()``."""


def parse_config(data: bytes, path: Path | None) -> dict[Key, object]:
    """Read a file's bytes.

    Args:
        data: UTF-8 text in TOML.
        path: For the text of errors.

    Returns:
        What it says, by key; only the types are checked.

    Raises:
        ConfigError: With line and key, if the text is not TOML, has an unknown key or a value of a wrong type.
    """
    if len(data) > limits.CONFIG_FILE_MAX:
        raise ConfigError(
            "the file", f"{len(data)} bytes, more than {limits.CONFIG_FILE_MAX}", "is it the right file?", path
        )
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigError("the file", "not UTF-8 text", "save it as UTF-8", path, line) from None
    table = _parse_toml(text, path)
    for place, suggestion in _unknown(table):
        what = "an unknown table" if isinstance(value_at(table, place), dict) else "an unknown key"
        raise ConfigError(dotted(place), what, REMOVED.get(dotted(place), suggestion), path, line_of(text, place))
    for place, value, types in _mistyped(table):
        problem, remedy = _type_mistake(place, value, types)
        raise ConfigError(dotted(place), problem, remedy, path, line_of(text, place))
    return {key: value for key in SCHEMAS if (value := value_at(table, key)) is not None}


def _parse_toml(text: str, path: Path | None) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ConfigError("the file", "lists or tables nested too deeply", "", path) from None
    except ValueError as error:  # TOMLDecodeError, and int() on thousands of digits
        message = str(error)
        match = _AT_LINE.search(message)
        line = int(match[1]) if match else text.rstrip().count("\n") + 1
        problem = f"not TOML: {_AT_LINE.sub('', message).removesuffix(' (at end of document)')}"
        raise ConfigError("the file", problem, _toml_remedy(text, line), path, line) from None


def _toml_remedy(text: str, line: int) -> str:
    lines = text.split("\n")
    written = lines[line - 1] if line <= len(lines) else ""
    match = re.match(r"\s*[\w.-]+\s*=\s*([^\s\"'\[{#][^#]*?)\s*(?:#.*)?$", written)
    if match and not re.match(r"(true|false|[-+0-9])", match[1]):
        return f'texts need quotes: "{match[1]}"'
    if re.match(r"\s*[\w.-]+\s*:", written):
        return "TOML writes key = value, not key: value"
    return ""


def dotted(place: Place) -> str:
    """A place as a user reads it, without the indices: the line says which one."""
    return ".".join(part for part in place if isinstance(part, str))


def _unknown(table: dict[str, Any]) -> Iterator[tuple[Place, str]]:
    """Unknown keys, each with what was probably meant."""
    everywhere = [key for key in SCHEMAS if key not in LISTS]
    everywhere += [(*name, key) for name, keys in LISTS.items() for key in keys]
    for place, key_of_table, inside, known in _tables((), table):
        for key in inside:
            if key not in known:
                yield (*place, key), _suggestion(key, key_of_table, everywhere, list(known))


def _tables(key: Key, value: object) -> Iterator[tuple[Place, Key, dict[str, Any], Sequence[str]]]:
    """A key's table and those in it: the place, the key, the table, and the keys that it may have."""
    if isinstance(value, dict) and (known := _TABLES.get(key)):
        yield key, key, value, known
        for name in value:
            yield from _tables((*key, name), value[name])
    for index, element in enumerate(value if key in LISTS and isinstance(value, list) else ()):
        if isinstance(element, dict):
            yield (*key, index), key, element, LISTS[key]


def _suggestion(word: str, table: Key, everywhere: list[Key], here: list[str]) -> str:
    """What to do about an unknown key: the key that was probably meant, or the table that it belongs in."""
    homes = [key for key in everywhere if key[-1] == word]
    near = did_you_mean(word, here)
    if near is not None and (table or not homes):
        return f"did you mean {'.'.join((*table, near))}?"
    if homes:
        return f"{word} belongs {_home(homes[0])}"
    near = did_you_mean(word, [key[-1] for key in everywhere])
    if near is not None:
        key = next(key for key in everywhere if key[-1] == near)
        return f"did you mean {'.'.join(key)}?"
    return f"known here: {', '.join(here)}"


def _home(key: Key) -> str:
    if len(key) == 1:
        return "above the first table"
    table = ".".join(key[:-1])
    return f"in a [[{table}]]" if key[:-1] in LISTS else f"in [{table}]"


def _mistyped(table: dict[str, Any]) -> Iterator[tuple[Place, object, list[str]]]:
    """Values of a wrong type: place, value, and the types (in JSON Schema's words) that it may have."""
    for place, value in _values((), table):
        if place not in _TABLES:
            yield from _mismatches(place, value, SCHEMAS[place])
        elif not isinstance(value, dict):
            yield place, value, ["object"]


def _values(key: Key, value: object) -> Iterator[tuple[Key, object]]:
    """Each value below a key that is not a table of settings; also what stands in the place of such a table."""
    if key in _TABLES and isinstance(value, dict):
        for name, inner in value.items():
            yield from _values((*key, name), inner)
    else:
        yield key, value


def _mismatches(place: Place, value: object, schema: JsonSchema) -> Iterator[tuple[Place, object, list[str]]]:
    """Mismatches of JSON Schema's ``type`` in a value and its elements; all else is checked by the readers."""
    expected = schema.get("type", [])
    types = [expected] if isinstance(expected, str) else expected
    if types and type(value) not in [_TYPES[name][0] for name in types]:
        yield place, value, types
    elif isinstance(value, list):
        for index, element in enumerate(value):
            yield from _mismatches((*place, index), element, schema.get("items", {}))
    elif isinstance(value, dict):
        known, other = schema.get("properties", {}), schema.get("additionalProperties")
        for key, inner in value.items():
            yield from _mismatches((*place, key), inner, known.get(key) or other or {})


def _type_mistake(place: Place, value: object, types: list[str]) -> tuple[str, str]:
    """The problem and the remedy for a value of a wrong type."""
    if place in LISTS and isinstance(value, dict):
        return "one table, where a list of them is expected", f"write [[{dotted(place)}]], in two brackets"
    problem = f"{shown(value)} is not {' or '.join(_TYPES[name][1] for name in types)}"
    return problem, f'did you mean ["{value}"]?' if types == ["array"] and isinstance(value, str) else ""


# Where settings come from, each source stronger than the one before it.
#
# ::
#
#     defaults < ROS environment < rmpa.toml < RMPA_* < options
#
# The module's name has one more: the name of its first start, which the state directory keeps
# (``config.module_name``).
# A source gives raw values and says where each was written; the types of ``config.settings`` read them. A setting
# that
# cannot be used is a ``ConfigError`` that names that place.


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
