"""What is made from the declarations of the settings: the JSON Schema, and the tables of docs/settings.md."""

from __future__ import annotations

import json
from dataclasses import asdict, is_dataclass
from enum import StrEnum
from functools import cache
from typing import TYPE_CHECKING, Final

from rmpa.config.settings import SETTINGS, TABLES
from rmpa.config.values import HostPort, Multicast

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.config.schema import Setting
    from rmpa.config.values import JsonSchema

# The schema's name in docs/.
SCHEMA_FILE: Final = "rmpa.schema.json"
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
    for setting in SETTINGS:
        inside = root["properties"]
        for depth, name in enumerate(setting.key[:-1], 1):
            about = TABLES[".".join(setting.key[:depth])]
            empty = {"type": "object", "description": about, "additionalProperties": False, "properties": {}}
            inside = inside.setdefault(name, empty)["properties"]
        entry = setting.type.json_schema | {"description": setting.help.replace("`", "")}
        if not setting.is_list_of_tables and not setting.shown_default and setting.default != "":
            entry["default"] = json_value(setting.default)
        if setting.key:
            inside[setting.key[-1]] = entry
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


def schema_text() -> str:
    """The JSON Schema as it is printed and stands in docs/."""
    return json.dumps(json_schema(), indent=2, ensure_ascii=False) + "\n"


def with_settings_tables(page: str) -> str:
    """A page of the documentation with its tables between the two marks written anew."""
    before, begin, rest = page.partition("<!-- tables: begin")
    mark, end = rest.partition("\n")[0], "<!-- tables: end -->"
    return f"{before}{begin}{mark}\n\n{settings_tables()}\n{end}{rest.partition(end)[2]}"
