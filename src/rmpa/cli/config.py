"""``rmpa config``: the settings that hold and where each comes from; their JSON Schema for editors."""

from __future__ import annotations

import os
import socket
from typing import TYPE_CHECKING

import click

from rmpa.cli.options import json_option
from rmpa.cli.output import Column, print_json, print_table, printable, warn
from rmpa.config.module_name import json_value, schema_text, toml_value
from rmpa.config.read import load_settings
from rmpa.config.settings import SETTINGS

if TYPE_CHECKING:
    from rmpa.config.schema import Setting

EPILOG = """\
\b
Examples:
  rmpa config show                        what `rmpa up` would take, and from where
  rmpa config show --config new.toml      is this file right?
  rmpa config schema > rmpa.schema.json   for editors: see docs/settings.md
"""


@click.group(epilog=EPILOG)
def config() -> None:
    """Show the settings and where each comes from; print their JSON Schema."""


@config.command()
@click.option("--config", "file", metavar="FILE", help="Settings. [default: ./rmpa.toml, ~/.config/rmpa, /etc/rmpa]")
@json_option
def show(file: str | None, as_json: bool) -> None:
    """Print each setting that `rmpa up` would take here, and where it comes from.

    A running agent may have others: options of its command line, or a file that was changed later (see rmpa reload).
    """
    host_name = socket.gethostname()
    loaded = load_settings({"config": file}, dict(os.environ), host_name=host_name)
    rows = []
    for setting in SETTINGS:
        given = loaded.given.get(setting.name)
        origin = str(given) if given else "the host's name" if setting.name == "name" else "default"
        rows.append((setting, setting.value_in(loaded.settings), origin))
    if as_json:
        print_json(
            {
                "file": str(loaded.settings.config_file or ""),
                "settings": [
                    {"name": s.title, "value": json_value(value), "from": origin} for s, value, origin in rows
                ],
                "notes": loaded.notes,
            }
        )
        return
    table = [(setting.title, _shown(setting, value), origin) for setting, value, origin in rows]
    print_table([Column("SETTING"), Column("VALUE"), Column("FROM")], [tuple(map(printable, row)) for row in table])
    for note in loaded.notes:
        warn(printable(note))


def _shown(setting: Setting, value: object) -> str:
    if setting.is_list_of_tables and isinstance(value, tuple):
        return f"{len(value)} table{'' if len(value) == 1 else 's'}" if value else "none"
    return toml_value(value)


@config.command()
def schema() -> None:
    """Print the JSON Schema of rmpa.toml: editors check and complete the file with it."""
    click.echo(schema_text(), nl=False)
