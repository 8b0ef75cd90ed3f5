"""Declares settings and rules: each key once, as a field of a dataclass.

::

    port: int = setting(0, PORT_OR_ANY, "The mesh's port.", key="mesh.port", option="--port")

From this line follow the typed field with its default, the key of ``rmpa.toml`` and the check of its type, the
environment variable (RMPA_PORT), the option of ``rmpa up`` or ``rmpa gateway``, the row of
docs/reference/settings.md and the entry of the JSON Schema.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass, field, fields, replace
from functools import reduce
from typing import TYPE_CHECKING, Any, Final, TypeVar

from rmpa.config.values import BOOL, BadValue, JsonSchema, ValueType, read_at, shown

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

_T = TypeVar("_T")
# A key of the file: ``("core", "port")``.
Key = tuple[str, ...]
# In place of a default: each rule must have the key.
NEEDED: Final[Any] = MISSING


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting or one key of a rule, with its name in each source.

    Attributes:
        type: How it is read and checked.
        help: What it does.
        default: Its value where no source gives one.
        key: Its key in the file; empty: not in the file.
        env: Its environment variable; may be empty.
        option: Its option, as click declares it; may be empty.
        shown_default: What the documentation says instead of the default; may be empty.
        live: Whether ``rmpa reload`` applies a change.
        command: The command that has the option.
        path: The attributes that lead from ``Settings`` to its value.
    """

    type: ValueType[Any]
    help: str
    default: object = None
    key: Key = ()
    env: str = ""
    option: str = ""
    shown_default: str = ""
    live: bool = False
    command: str = "up"
    path: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The attributes with dots: ``realtime.cpus``."""
        return ".".join(self.path)

    @property
    def title(self) -> str:
        """Its name for users: ``core.port``, ``[[contract]]``, or the variable if it is not in the file."""
        dotted = ".".join(self.key)
        return f"[[{dotted}]]" if self.is_list_of_tables else dotted or self.env

    @property
    def flag(self) -> str:
        """The option as a user types it: ``--realtime``."""
        return self.option.partition("/")[0]

    @property
    def option_name(self) -> str:
        """The option's name among click's parameters: ``core_port`` for ``--core-port``."""
        return self.flag.removeprefix("--").replace("-", "_")

    @property
    def is_list_of_tables(self) -> bool:
        """Whether it is a list of tables such as ``[[contract]]``."""
        return "properties" in self.type.json_schema.get("items", {})

    @property
    def has_tables(self) -> bool:
        """Whether its value is a table or a list of them; then it is in the file alone."""
        return self.is_list_of_tables or self.type.json_schema.get("type") == "object"

    @property
    def is_list(self) -> bool:
        """Whether its value is a list; then its option may be repeated."""
        return bool(self.type.json_schema.get("type") == "array")

    @property
    def is_switch(self) -> bool:
        """Whether it is true or false; then its option has no value."""
        return bool(self.type.json_schema.get("type") == "boolean")

    def value_in(self, settings: object) -> object:
        """Its value in a ``Settings``."""
        return reduce(getattr, self.path, settings)

    def put(self, settings: _T, value: object) -> _T:
        """A ``Settings`` that has another value of it."""
        return _with(settings, self.path, value)


def _with(table: _T, path: Sequence[str], value: object) -> _T:
    """A dataclass of settings with one other value, at a path of attributes."""
    name, *rest = path
    inner = _with(getattr(table, name), rest, value) if rest else value
    return replace(table, **{name: inner})  # type: ignore[type-var] # each is a dataclass of settings


def setting(
    default: _T,
    value_type: ValueType[_T],
    help: str,  # noqa: A002 - as click and argparse have it
    *,
    key: str | None = None,
    env: str = "",
    option: str = "",
    shown_default: str = "",
    live: bool = False,
) -> _T:
    """Declare a setting, or a key of a rule: the right-hand side of a field of a dataclass.

    Args:
        default: Its value where no source gives one; ``NEEDED``: a key that each rule must have.
        value_type: How it is read and checked.
        help: What it does, in one or two sentences: for ``--help``, the documentation and editors.
        key: Its key in ``rmpa.toml``, with dots; by default the field's name in its table; empty: not in the file.
        env: Its environment variable; by default RMPA_ with the table's word and the field's name, which ``enabled``
            leaves out. What has tables has none.
        option: Its option (``--port``, ``--realtime/--no-realtime``); empty: none.
        shown_default: What the documentation says instead of the default.
        live: Whether ``rmpa reload`` applies a change; else it needs a restart. True for all of a live table.
    """
    it = Setting(value_type, help, default, (), env, option, shown_default, live)
    made: _T = field(default=default, metadata={"setting": it, "key": key})
    return made


def switch(
    help: str,  # noqa: A002 - as of ``setting``
    *,
    default: bool = False,
    key: str | None = None,
    option: str = "",
    live: bool = False,
) -> bool:
    """Declare a setting that is true or false; the arguments are those of ``setting``."""
    return setting(default, BOOL, help, key=key, option=option, live=live)


def table(kind: type[_T], name: str, env: str = "", *, live: bool = False, command: str = "up") -> _T:
    """Declare a field that holds a settings dataclass of its own.

    Args:
        kind: The dataclass.
        name: Its table in ``rmpa.toml``, with dots for one in another (``gateway.ros2``).
        env: The word that its environment variables have behind ``RMPA_``.
        live: Whether ``rmpa reload`` applies changes in it.
        command: The command of ``rmpa`` that has its options: ``up``, or ``gateway``, which has those of ``up`` too.
    """
    place = {"table_key": tuple(name.split(".")), "env": env, "live": live, "command": command}
    made: _T = field(default_factory=kind, metadata={"table": (kind, place)})
    return made


def settings_of(
    kind: type,
    path: tuple[str, ...] = (),
    *,
    table_key: Key = (),
    env: str = "",
    live: bool = False,
    command: str = "up",
) -> Iterator[Setting]:
    """Every setting that a dataclass declares, in order, those of its tables in their place.

    Args:
        kind: The dataclass.
        path: The attributes that lead to it.
        table_key: Its table in the file; empty for the file itself.
        env: The word that its environment variables have behind ``RMPA_``.
        live: Whether it is in a live table.
        command: The command that has its options.
    """
    for item in fields(kind):
        where = (*path, item.name)
        if "table" in item.metadata:
            inner, place = item.metadata["table"]
            yield from settings_of(inner, where, **place)
        elif it := item.metadata.get("setting"):
            said = item.metadata["key"]
            key = (*table_key, item.name) if said is None else tuple(said.split(".")) if said else ()
            words = ("RMPA", env, "" if item.name == "enabled" else item.name.upper())
            variable = "" if it.has_tables else it.env or "_".join(filter(None, words))
            yield replace(it, path=where, key=key, env=variable, live=live or it.live, command=command)


def keys_of(kind: type) -> dict[str, Setting]:
    """The keys that a dataclass of a rule declares, by their names in the file."""
    return {it.key[-1]: it for it in settings_of(kind) if it.key}


def rules_of(
    keys: Mapping[str, Setting],
    make: Callable[[dict[str, Any]], _T],
    example: str = "",
    most: int = 0,
    instead: str = "",
) -> ValueType[tuple[_T, ...]]:
    """A list of tables (``[[contract]]``); errors name the table's index and its key.

    Args:
        keys: The keys that each table may have; ``config.read`` has checked that there are no others.
        make: Makes a rule of the values of those keys that a table has.
        example: What a complete table has, for the error about a key that is missing.
        most: How many tables there may be; 0: any number.
        instead: What to do about more.
    """
    needed = [name for name, key in keys.items() if key.default is NEEDED]

    def read_table(raw: Mapping[str, object]) -> _T:
        for name in needed:
            if name not in raw:
                raise BadValue(f"a rule without {name}", example)
        return make({name: read_at(name, key.type.read, raw[name]) for name, key in keys.items() if name in raw})

    def read(raw: object) -> tuple[_T, ...]:
        if not isinstance(raw, list | tuple):
            raise BadValue(f"{shown(raw)} is not a list")
        if most and len(raw) > most:
            raise BadValue(f"{len(raw)} rules", f"at most {most}; {instead}")
        return tuple(read_at(index, read_table, table) for index, table in enumerate(raw))

    schema: JsonSchema = {
        "type": "object",
        "additionalProperties": False,
        "properties": {name: key.type.json_schema | {"description": key.help} for name, key in keys.items()},
    }
    return ValueType(read, {"type": "array", "items": schema | ({"required": needed} if needed else {})})
