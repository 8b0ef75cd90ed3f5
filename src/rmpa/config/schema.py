"""Declares settings, each once, as a field of a settings dataclass; reads quantities with units.

Declares settings: each once, as a field of a settings dataclass.

::

    port: int = setting(0, PORT_OR_ANY, "The mesh's port.", key="mesh.port", env="RMPA_PORT", option="--port")

From this line follow the typed field with its default, the key of ``rmpa.toml`` and the check of its type, the
environment variable, the option of ``rmpa up`` or ``rmpa gateway``, the row of docs/settings.md and the entry of the
JSON Schema.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, fields
from functools import reduce
from typing import TYPE_CHECKING, Any, Final, TypeVar

from rmpa.config import limits
from rmpa.config.values import BadValue, JsonSchema, ValueType, shown
from rmpa.core import limits as core_limits

if TYPE_CHECKING:
    from collections.abc import Iterator

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


# Durations and rates as users write them: numbers in seconds and messages a second, or texts with a unit.


_QUANTITY: Final = re.compile(r"([0-9]{1,9}(?:\.[0-9]{1,9})?)\s*([a-zµ]*)")
_SECONDS: Final = {"us": 1e6, "µs": 1e6, "ms": 1e3, "s": 1.0, "min": 1 / 60, "h": 1 / 3600}
"""By unit: so many of it are a second. Dividing by these rounds only once, so that ``"100 ms"`` is exactly 0.1."""
_BYTES: Final = {
    "b": 1.0,
    "kb": 1e3,
    "mb": 1e6,
    "gb": 1e9,
    "kib": 1024.0,
    "mib": 1048576.0,
    "kbit": 125.0,
    "mbit": 125e3,
    "gbit": 125e6,
}
"""By unit: so many bytes it is."""
_FLOW: Final = re.compile(rf"([0-9]{{1,9}}(?:\.[0-9]{{1,9}})?)\s*({'|'.join(_BYTES)})(?:/s)?", re.IGNORECASE)
_INFINITE: Final = "infinite"
"""ROS 2's own word for a duration without a bound; it lifts the bound that an earlier rule has set."""
_UNLIMITED: Final = "unlimited"
"""The word for a rate without a bound, likewise."""


def read_duration(raw: object, what: str = "a duration") -> float | None:
    """Seconds as a number, or a text such as ``"100 ms"`` or ``"2 s"``; ``"infinite"`` is ``None``.

    Args:
        raw: As written.
        what: What the duration is, with its article, for the text of errors.

    Raises:
        BadValue: It is not a duration, or outside of 1 ms to a day.
    """
    seconds = _seconds(raw, what)
    if seconds == math.inf:
        return None
    if not core_limits.CONTRACT_TIME_MIN <= seconds <= core_limits.CONTRACT_TIME_MAX:
        bounds = f"{core_limits.CONTRACT_TIME_MIN:g} and {core_limits.CONTRACT_TIME_MAX:.0f} s"
        raise BadValue(f"{shown(raw)} is out of range", f'{what} is between {bounds}; "{_INFINITE}" is none at all')
    return seconds


def read_outage(raw: object) -> float:
    """How long messages are kept for a peer whose link is gone, in seconds; unlike other durations it has an end."""
    seconds = _seconds(raw, "an outage")
    shortest, longest = core_limits.OUTAGE_MIN, core_limits.OUTAGE_MAX
    if not shortest <= seconds <= longest:
        bounds = f"an outage is between {shortest:g} and {longest:.0f} s: messages are not kept for ever"
        raise BadValue(f"{shown(raw)} is out of range", bounds)
    return seconds


def read_timeout(raw: object) -> float:
    """How long a service call may take, in seconds; there is always an end."""
    seconds = read_duration(raw, "a timeout")
    if seconds is None or seconds > limits.SERVICE_TIMEOUT_MAX:
        raise BadValue(
            f"{raw!r} is too long for a call", f"at most {limits.SERVICE_TIMEOUT_MAX:g} s: an action can say more"
        )
    return seconds


def read_rate(raw: object) -> float | None:
    """Messages a second as a number, or a text such as ``"10 Hz"``; ``"unlimited"`` is ``None``.

    Raises:
        BadValue: It is not a rate, or outside of the bounds in ``config.limits``.
    """
    example = 'a rate is messages a second as a number, or a text such as "10 Hz"'
    if isinstance(raw, str):
        text = raw.strip().lower()
        if text == _UNLIMITED:
            return None
        number, unit = _quantity(text)
        if number and unit in _SECONDS:
            raise BadValue(f"{raw!r} is a duration, not a rate", better=f"{_SECONDS[unit] / number:g} Hz")
        if number is None or unit != "hz":
            raise BadValue(f"{raw!r} is not a rate", example)
        rate = number
    else:
        rate = _number(raw, "a rate", example)
    if rate == math.inf:
        return None
    if not core_limits.CONTRACT_RATE_MIN <= rate <= core_limits.CONTRACT_RATE_MAX:
        bounds = f"{core_limits.CONTRACT_RATE_MIN:g} and {core_limits.CONTRACT_RATE_MAX:.0f} Hz"
        raise BadValue(f"{shown(raw)} is out of range", f'a rate is between {bounds}; "{_UNLIMITED}" is none at all')
    return rate


def read_bytes_a_second(raw: object) -> int | None:
    """Bytes a second as a number, or a text such as ``"100 KB/s"`` or ``"1 Mbit/s"``; ``"unlimited"`` is ``None``.

    Raises:
        BadValue: It is not such a quantity, or outside of the bounds in ``config.limits``.
    """
    example = 'a size is bytes a second as a number, or a text such as "100 KB/s" or "1 Mbit/s"'
    if isinstance(raw, str):
        text = raw.strip()
        if text.lower() == _UNLIMITED:
            return None
        match = _FLOW.fullmatch(text)
        if match is None:
            raise BadValue(f"{raw!r} is not a number of bytes a second", example)
        found = float(match[1]) * _BYTES[match[2].lower()]
    else:
        found = _number(raw, "a number of bytes a second", example)
    if found == math.inf:
        return None
    if not 1 <= found <= limits.GATEWAY_BYTES_MAX:
        bounds = f'a size is between 1 and {limits.GATEWAY_BYTES_MAX:,} bytes a second; "{_UNLIMITED}" is none at all'
        raise BadValue(f"{shown(raw)} is out of range", bounds)
    return int(found)


def _seconds(raw: object, what: str) -> float:
    """A duration in seconds, before its bounds are checked."""
    example = f'{what} is seconds as a number, or a text such as "100 ms"'
    if not isinstance(raw, str):
        return _number(raw, "a duration", example)
    text = raw.strip().lower()
    if text == _INFINITE:
        return math.inf
    number, unit = _quantity(text)
    if number and unit == "hz":
        raise BadValue(f"{raw!r} is a rate, not a duration", better=f"{1000 / number:g} ms")
    if number is None or unit not in _SECONDS:
        raise BadValue(f"{raw!r} is not a duration", f"{example}; units are {', '.join(_SECONDS)}")
    return number / _SECONDS[unit]


def _quantity(text: str) -> tuple[float | None, str]:
    match = _QUANTITY.fullmatch(text)
    return (float(match[1]), match[2]) if match else (None, "")


def _number(raw: object, what: str, example: str) -> float:
    if isinstance(raw, bool) or not isinstance(raw, int | float) or math.isnan(raw):
        raise BadValue(f"{shown(raw)} is not {what}", example)
    return float(raw)  # TOML's whole numbers have 64 bits


def _number_or_text(*examples: object) -> JsonSchema:
    # Without "type": the reader's own error about a wrong type says more than that of config.file.
    return {"anyOf": [{"type": "number"}, {"type": "string"}], "examples": list(examples)}


def duration_of(what: str) -> ValueType[float | None]:
    """A duration that may be infinite; ``what`` names it with its article, for the text of errors."""
    return ValueType(lambda raw: read_duration(raw, what), _number_or_text(0.5, "100 ms", _INFINITE))


OUTAGE: Final = ValueType(read_outage, _number_or_text(30, "5 min"))
TIMEOUT: Final = ValueType(read_timeout, _number_or_text(60, "5 min"))
RATE: Final = ValueType(read_rate, _number_or_text(10, "10 Hz", _UNLIMITED))
BYTES_A_SECOND: Final = ValueType(read_bytes_a_second, _number_or_text(125_000, "100 KB/s", "1 Mbit/s", _UNLIMITED))
