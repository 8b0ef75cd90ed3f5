"""Which module a command is about, where it keeps its state, and the text of docs/settings.md.

Which module a command is about: one decision for all commands.

::

    option > RMPA_AGENT > RMPA_NAME > rmpa.toml > the agent that runs > the name of the first start > the default

A name that is *said* (the first four) holds, whatever runs. Agents that run count for commands beside an agent alone:
``rmpa up`` starts one.
"""

from __future__ import annotations

import contextlib
import json
import os
import pwd
import re
from dataclasses import asdict, dataclass, is_dataclass
from enum import Enum, StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.config.settings import SETTINGS, TABLES
from rmpa.config.values import HostPort, Multicast
from rmpa.core.errors import ConfigError, RmpaError, StartError
from rmpa.core.identity import peer_name_problem

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from rmpa.config.schema import Setting
    from rmpa.config.values import JsonSchema

GATEWAY_SUFFIX = "_gateway"
"""What a gateway's name has behind that of its module."""


class NameSource(Enum):
    """Why a name was chosen."""

    OPTION = "the option"
    AGENT_VARIABLE = "RMPA_AGENT"
    VARIABLE = "RMPA_NAME"
    FILE = "name in rmpa.toml"
    RUNNING = "the agent that runs here"
    KEPT = "the name of the first start"
    DEFAULT = "this host's name"

    @property
    def said(self) -> bool:
        """Whether the user has said it for this command; it then holds, whatever runs."""
        return self in _SAID


_SAID = frozenset((NameSource.OPTION, NameSource.AGENT_VARIABLE, NameSource.VARIABLE, NameSource.FILE))


@dataclass(frozen=True, slots=True)
class NameFacts:
    """What the choice depends on. Empty: there is none.

    Attributes:
        option: ``--name`` or ``--agent``.
        agent_variable: RMPA_AGENT; commands that start an agent leave it out.
        variable: RMPA_NAME.
        file: ``name`` in ``rmpa.toml``.
        running: The agents that run on this machine; commands that start one leave them out.
        gateways: Those among them that are gateways.
        of_master: The one among them whose core ROS_MASTER_URI names.
        kept: The name that is kept in the state directory.
        default: The name without any of these.
    """

    option: str = ""
    agent_variable: str = ""
    variable: str = ""
    file: str = ""
    running: tuple[str, ...] = ()
    gateways: tuple[str, ...] = ()
    of_master: str = ""
    kept: str = ""
    default: str = ""


@dataclass(frozen=True, slots=True)
class ModuleName:
    """A name, and why it was chosen."""

    name: str
    source: NameSource

    def __str__(self) -> str:
        """``base (name in rmpa.toml)``."""
        return f"{self.name} ({self.source.value})"


def choose_name(facts: NameFacts) -> ModuleName:
    """The module that a command is about.

    Raises:
        RmpaError: Several agents run, and nothing says which is meant.
    """
    for name, source in (
        (facts.option, NameSource.OPTION),
        (facts.agent_variable, NameSource.AGENT_VARIABLE),
        (facts.variable, NameSource.VARIABLE),
        (facts.file, NameSource.FILE),
    ):
        if name:
            return ModuleName(name, source)
    if facts.running:
        return ModuleName(running_agent(facts), NameSource.RUNNING)
    if facts.kept:
        return ModuleName(facts.kept, NameSource.KEPT)
    return ModuleName(facts.default, NameSource.DEFAULT)


def running_agent(facts: NameFacts) -> str:
    """Which of the agents that run is meant: the only one, that of ROS_MASTER_URI, that of a name, the only module.

    Args:
        facts: With at least one agent. The names of variable, file and first start choose only among them.

    Raises:
        RmpaError: It could be several.
    """
    if len(facts.running) == 1:
        return facts.running[0]
    for name in (facts.of_master, facts.variable, facts.file, facts.kept):
        if name in facts.running:
            return name
    modules = [name for name in facts.running if name not in facts.gateways]
    if len(modules) == 1:
        return modules[0]
    listed = ", ".join(facts.running)
    raise RmpaError(f"several agents run on this machine: {listed}; name one with --agent NAME or RMPA_AGENT")


# The directory of files that survive a program's end, and the name of this machine's module, which is kept there.


def state_dir(environ: Mapping[str, str], setting: str | None = None) -> Path | None:
    """The directory of all files that survive a run; it need not exist yet.

    The first of: the setting, RMPA_STATE_DIR, STATE_DIRECTORY (systemd's, for a unit with ``StateDirectory=``),
    ``rmpa`` below XDG_STATE_HOME, ``~/.local/state/rmpa``.

    Returns:
        ``None`` if none of these is set and the user has no home directory.
    """
    if setting or environ.get("RMPA_STATE_DIR"):
        return Path(setting or environ["RMPA_STATE_DIR"])
    if environ.get("STATE_DIRECTORY"):
        return Path(environ["STATE_DIRECTORY"].partition(":")[0])
    if environ.get("XDG_STATE_HOME"):
        return Path(environ["XDG_STATE_HOME"]) / "rmpa"
    if environ.get("HOME"):
        return Path(environ["HOME"]) / ".local" / "state" / "rmpa"
    return None


def module_dir(directory: Path, module: str) -> Path:
    """The folder of one module's files within the state directory."""
    return directory / (re.sub(r"[^\w.-]", "_", module).lstrip(".") or "_")


def core_file(environ: Mapping[str, str], port: int, module: str = "", setting: str = "") -> Path | None:
    """The file of a ROS core, named by module and port, so that two cores on one machine do not share a file.

    Args:
        environ: As for ``state_dir``.
        port: The core's port; with 0 (chosen by the system) there is no file, because the next run has another port.
        module: Empty for a core without an agent.
        setting: As for ``state_dir``.
    """
    directory = state_dir(environ, setting or None)
    if directory is None or not port:
        return None
    return (module_dir(directory, module) if module else directory) / f"core-{port}.state"


# --- the module's name ----------------------------------------------------------------------------------------------

NAME_FILE: Final = "module-name"
"""In the state directory: the name of this machine's module. No folder of a module is named so: it has a dash."""
PLACES_FILE: Final = "state-directories"
"""In the usual state directory: others in which this user's modules have joined a secured mesh, one a line."""
_READ_MAX: Final = 64 * 1024
_SYSTEM: Final = Path("/var/lib/rmpa")
"""The state directory of a systemd unit with ``StateDirectory=rmpa``."""


def kept_name(directory: Path | None) -> str:
    """The name that is kept in a state directory; empty: none, or this user cannot read it.

    Raises:
        ConfigError: The file has something else.
    """
    if directory is None:
        return ""
    text = _read(directory / NAME_FILE).strip()
    if text and (problem := peer_name_problem(text)):
        raise ConfigError("the module's name", problem, "write it there, or remove the file", directory / NAME_FILE)
    return text


def keep_name(directory: Path, name: str, *, instead: bool = False) -> bool:
    """Keep a name as that of this machine's module; return whether it is kept there now.

    Args:
        directory: The state directory; made if needed.
        name: The name.
        instead: Whether it takes the place of another one; else the first one stays.

    Raises:
        StartError: It cannot be written.
    """
    path = directory / NAME_FILE
    temporary = path.with_name(f".{NAME_FILE}.{os.getpid()}")
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        temporary.write_text(f"{name}\n", encoding="ascii")
        owner = directory.stat()
        if os.geteuid() == 0 and owner.st_uid != 0:  # the agent runs as that user, and is to read it
            os.chown(temporary, owner.st_uid, owner.st_gid)
        try:
            if instead:
                temporary.replace(path)
            else:
                os.link(temporary, path)  # fails where there is one already: of two first starts one is the first
        except FileExistsError:
            return kept_name(directory) == name
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise StartError(str(path), f"cannot be written: {error.strerror}", "say --name at each start") from None
    return True


def usual_state_dirs(environ: Mapping[str, str]) -> list[Path]:
    """The state directories where nothing names one (no setting, RMPA_STATE_DIR or STATE_DIRECTORY), our own last.

    Without HOME, as a unit of the system has none, it is that of the user's home directory all the same; under
    ``sudo`` there is also that of the user who called it.
    """
    said = ("RMPA_STATE_DIR", "STATE_DIRECTORY")
    usual = state_dir({name: value for name, value in environ.items() if name not in said})
    caller = environ.get("SUDO_UID", "")
    homes = [_home_of(int(caller))] if caller.isdecimal() else []
    homes.append(usual or _home_of(os.geteuid()))
    return list(dict.fromkeys(place for place in homes if place is not None))


def _home_of(user: int) -> Path | None:
    try:
        return Path(pwd.getpwuid(user).pw_dir) / ".local" / "state" / "rmpa"
    except (KeyError, OverflowError):
        return None


def other_state_dirs(environ: Mapping[str, str], used: Path | None) -> list[Path]:
    """State directories besides the one in use in which modules of this user may have files: as far as it is known.

    Args:
        environ: As for ``state_dir``.
        used: The one in use.
    """
    usual = usual_state_dirs(environ)
    listed = [line for place in usual for line in _read(place / PLACES_FILE).splitlines() if line]
    places = [*usual, *map(Path, listed), _SYSTEM]
    return [place for place in dict.fromkeys(places) if place != used]


def note_state_dir(environ: Mapping[str, str], used: Path) -> None:
    """Note in the usual state directory that there is another one, so that a start without its name is noticed.

    It is of use to the same user alone; where it cannot be written, nothing is noted.
    """
    usual, used = usual_state_dirs(environ)[-1:], used.absolute()
    if not usual or usual[0] == used or used in map(Path, _read(usual[0] / PLACES_FILE).splitlines()):
        return
    with contextlib.suppress(OSError):
        usual[0].mkdir(mode=0o700, parents=True, exist_ok=True)
        with (usual[0] / PLACES_FILE).open("a", encoding="utf-8") as file:
            file.write(f"{used}\n")


def _read(path: Path) -> str:
    try:
        if not path.is_file():  # a pipe would be waited for
            return ""
        with path.open("rb") as file:
            return file.read(_READ_MAX).decode("utf-8", "replace")
    except OSError:
        return ""


# Made from the declarations of the settings: the tables of docs/settings.md, and the JSON Schema for editors.


SCHEMA_FILE: Final = "rmpa.schema.json"
"""The schema's name in docs/."""
_TYPE_NAMES: Final = {"string": "text", "integer": "whole number", "boolean": "true, false", "object": "table"}


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


def json_schema() -> JsonSchema:
    """The JSON Schema (draft 7) of ``rmpa.toml``."""
    properties: JsonSchema = {}
    for setting in SETTINGS:
        if not setting.key:
            continue
        entry = setting.type.json_schema | {"description": _plain(setting.help)}
        if not setting.is_list_of_tables and not setting.shown_default and setting.default != "":
            entry["default"] = json_value(setting.default)
        inside = properties
        for depth, name in enumerate(setting.key[:-1], 1):
            inside = inside.setdefault(name, _table(".".join(setting.key[:depth])))["properties"]
        inside[setting.key[-1]] = entry
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "rmpa.toml",
        "description": "The settings of one RMPA agent.",
        "type": "object",
        "additionalProperties": False,
        "properties": properties,
    }


def _table(name: str) -> JsonSchema:
    return {"type": "object", "description": TABLES[name], "additionalProperties": False, "properties": {}}


def json_value(value: object) -> object:
    """A setting's value as JSON has it: addresses as text, rules as objects of the keys that they have."""
    if isinstance(value, tuple):
        return [json_value(element) for element in value]
    if isinstance(value, Multicast | HostPort):
        return str(value) if value != Multicast(enabled=False) else False
    if is_dataclass(value) and not isinstance(value, type):
        return {key: json_value(part) for key, part in asdict(value).items() if part is not None}
    return value.value if isinstance(value, StrEnum) else value


def settings_tables() -> str:
    """The reference of all settings in Markdown: a heading and a table for each table of the file."""
    parts: list[str] = []
    for name in ("", *TABLES):
        rows = [s for s in SETTINGS if not s.is_list_of_tables and ".".join(s.key[:-1]) == name and s.key]
        title, text = (f"## `[{name}]`", TABLES[name]) if name else ("## Above the first table", "")
        parts += [title, text, _markdown(_setting_rows(rows))]
    for setting in SETTINGS:
        if setting.is_list_of_tables:
            rows_of_keys = list(_key_rows(setting.type.json_schema["items"]))
            parts += [f"## `{setting.title}`", setting.help, _markdown(rows_of_keys)]
    only_variables = [s for s in SETTINGS if not s.key]
    parts += ["## Environment variables only", _markdown(_setting_rows(only_variables))]
    return "\n\n".join(part for part in parts if part) + "\n"


def _setting_rows(settings: list[Setting]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [("setting", "default", "variable", "option", "reload", "what it does")]
    for setting in settings:
        default = setting.shown_default or f"`{toml_value(setting.default)}`"
        key = f"`{setting.key[-1]}`" if setting.key else f"`{setting.env}`"
        option = ", ".join(f"`{part}`" for part in setting.option.split("/")) if setting.option else ""
        variable = f"`{setting.env}`" if setting.env and setting.key else ""
        rows.append((key, default, variable, option, "yes" if setting.live else "", setting.help))
    if not any(row[3] for row in rows[1:]):
        rows = [(*row[:3], *row[4:]) for row in rows]
    if not any(row[2] for row in rows[1:]):
        rows = [(*row[:2], *row[3:]) for row in rows]
    return rows


def _key_rows(table: JsonSchema) -> Iterator[tuple[str, ...]]:
    yield ("key", "value", "what it says")
    for name, schema in table["properties"].items():
        needed = " (needed)" if name in table.get("required", ()) else ""
        yield (f"`{name}`{needed}", _type_name(schema), schema["description"])


def _type_name(schema: JsonSchema) -> str:
    if "enum" in schema:
        return ", ".join(f"`{word}`" for word in schema["enum"])
    if schema.get("type") == "array":
        return "tables" if "properties" in schema["items"] else f"list of {_type_name(schema['items'])}s"
    if "anyOf" in schema:
        return ", ".join(f"`{toml_value(example)}`" for example in schema["examples"])
    if "minimum" in schema:
        return f"{schema['minimum']} to {schema['maximum']}"
    return _TYPE_NAMES[schema["type"]]


def _markdown(rows: list[tuple[str, ...]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


def _plain(text: str) -> str:
    return text.replace("`", "")


def schema_text() -> str:
    """The JSON Schema as it is printed and stands in docs/."""
    return json.dumps(json_schema(), indent=2, ensure_ascii=False) + "\n"


def with_settings_tables(page: str) -> str:
    """A page of the documentation with its tables between the two marks written anew."""
    before, begin, rest = page.partition("<!-- tables: begin")
    mark, end = rest.partition("\n")[0], "<!-- tables: end -->"
    return f"{before}{begin}{mark}\n\n{settings_tables()}\n{end}{rest.partition(end)[2]}"
