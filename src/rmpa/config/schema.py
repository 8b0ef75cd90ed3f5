"""Declares settings: each once, as a field of a settings dataclass.

::

    port: int = setting(0, PORT_OR_ANY, "The mesh's port.", key="mesh.port", env="RMPA_PORT", option="--port")

From this line follow the typed field with its default, the key of ``rmpa.toml`` and the check of its type, the
environment variable, the option of ``rmpa up`` or ``rmpa gateway``, the row of docs/settings.md and the entry of the
JSON Schema.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import reduce
from typing import TYPE_CHECKING, Any, Final, TypeVar

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.config.values import ValueType

_T = TypeVar("_T")
Key = tuple[str, ...]
"""A key of the file: ``("core", "port")``."""
_SETTING: Final = "rmpa.setting"
_TABLE: Final = "rmpa.table"


@dataclass(frozen=True, slots=True)
class _Declaration:
    type: ValueType[Any]
    help: str
    key: str | None
    env: str
    option: str
    shown_default: str
    live: bool
    command: str


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
    command: str = "up",
) -> _T:
    """Declare a setting: the right-hand side of a field of a settings dataclass.

    Args:
        default: Its value where no source gives one.
        value_type: How it is read and checked.
        help: What it does, in one or two sentences: for ``--help``, the documentation and editors.
        key: Its key in ``rmpa.toml``, with dots; by default the field's name in its table; empty: not in the file.
        env: Its environment variable; empty: none.
        option: Its option of ``command`` (``--port``, ``--realtime/--no-realtime``); empty: none.
        shown_default: What the documentation says instead of the default.
        live: Whether ``rmpa reload`` applies a change; else it needs a restart. True for all of a live table.
        command: The command of ``rmpa`` that has the option: ``up``, or ``gateway``, which has those of ``up`` too.
    """
    declared = _Declaration(value_type, help, key, env, option, shown_default, live, command)
    made: _T = field(default=default, metadata={_SETTING: declared})
    return made


def table(kind: type[_T], name: str, *, live: bool = False) -> _T:
    """Declare a field that holds a settings dataclass of its own.

    Args:
        kind: The dataclass.
        name: Its table in ``rmpa.toml``, with dots for one in another (``gateway.ros2``).
        live: Whether ``rmpa reload`` applies changes in it.
    """
    made: _T = field(default_factory=kind, metadata={_TABLE: (kind, name, live)})
    return made


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting, with its name in each source.

    Args:
        path: The attributes that lead from ``Settings`` to its value.
        type: How it is read and checked.
        help: What it does.
        default: Its value where no source gives one.
        key: Its key in the file; empty: not in the file.
        env: Its environment variable; may be empty.
        option: Its option, as click declares it; may be empty.
        shown_default: What the documentation says instead of the default; may be empty.
        live: Whether ``rmpa reload`` applies a change.
        command: The command that has the option.
    """

    path: tuple[str, ...]
    type: ValueType[Any]
    help: str
    default: object
    key: Key
    env: str
    option: str
    shown_default: str
    live: bool
    command: str

    @property
    def name(self) -> str:
        """The attributes with dots: ``realtime.cpus``."""
        return ".".join(self.path)

    @property
    def title(self) -> str:
        """Its name for users: ``core.port``, ``[[contract]]``, or the variable if it is not in the file."""
        if self.is_list_of_tables:
            return f"[[{'.'.join(self.key)}]]"
        return ".".join(self.key) or self.env

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


def settings_of(
    kind: type, path: tuple[str, ...] = (), table_name: str = "", *, live: bool = False
) -> Iterator[Setting]:
    """Every setting that a dataclass declares, in order, those of its tables in their place.

    Args:
        kind: The dataclass.
        path: The attributes that lead to it.
        table_name: Its table in the file; empty for the file itself.
        live: Whether it is in a live table.
    """
    for item in fields(kind):
        where = (*path, item.name)
        if _TABLE in item.metadata:
            inner, name, inner_live = item.metadata[_TABLE]
            yield from settings_of(inner, where, name, live=inner_live)
        elif _SETTING in item.metadata:
            it: _Declaration = item.metadata[_SETTING]
            dotted = f"{table_name}.{item.name}".removeprefix(".") if it.key is None else it.key
            key = tuple(dotted.split(".")) if dotted else ()
            yield Setting(
                where,
                it.type,
                it.help,
                item.default,
                key,
                it.env,
                it.option,
                it.shown_default,
                live or it.live,
                it.command,
            )


REMOVED: Final = {
    "peer.remap": 'write remap_in = { "FROM" = "TO" } for direction = "in", remap_out = { "FROM" = "TO" } for "out"; '
    "it holds for topics of all types",
    "web_token": "use the one token; control and drive of [web] say what clients may do with it",
    "core.fresh": 'write keep = "never" in place of true',
    "RMPA_FRESH": "set RMPA_KEEP=never in its place",
    "--fresh": "write --keep never",
    "--known": "rosbag record /SONAR/descriptor keeps what a resource was",
    **dict.fromkeys(
        ("realtime.cpus", "RMPA_REALTIME_CPUS"),
        "write CPUAffinity= into the systemd unit, or start it by `taskset -c`",
    ),
    **dict.fromkeys(
        ("realtime.keep_awake", "RMPA_REALTIME_KEEP_AWAKE"),
        "keep the CPUs awake by the system: tuned's profile latency-performance, or processor.max_cstate=1",
    ),
    **dict.fromkeys(
        (
            "gateway.ros1_bridge",
            "gateway.ros1_bridge_namespace",
            "RMPA_GATEWAY_ROS1_BRIDGE",
            "RMPA_GATEWAY_ROS1_BRIDGE_NAMESPACE",
            "--ros1-bridge",
            "--no-ros1-bridge",
        ),
        "let a gateway with a site name join those robots, or run zenoh-bridge-ros1 beside rmpa",
    ),
    **dict.fromkeys(
        ("mesh.links", "mesh.full_mesh_up_to", "RMPA_LINKS", "RMPA_FULL_MESH_UP_TO"),
        "leave it out: up to 256 modules keep a link to each other; make more of them sites (docs/sites.md)",
    ),
    **dict.fromkeys(
        ("gateway.store", "RMPA_GATEWAY_STORE", "gateway.rule.keep"),
        "no gateway keeps values: record the topic with rosbag, or keep its key by a storage of Zenoh",
    ),
    "--yes": "leave it out: nothing is asked",
}
"""What to use in place of a key, variable or option that is gone."""
