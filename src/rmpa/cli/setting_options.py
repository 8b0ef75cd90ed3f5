"""Options of commands that follow from the declarations of the settings."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from rmpa.config.settings import SETTINGS

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from rmpa.config.schema import Setting

config_option = click.option(
    "--config", metavar="FILE", help="Settings. [default: ./rmpa.toml, ~/.config/rmpa, /etc/rmpa]"
)


def setting_options(
    *commands: str, without: Collection[str] = (), defaults: dict[str, str] | None = None
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorate a command with an option for each setting that has one, in the order of their declarations.

    Args:
        commands: Those in whose name the settings declare options; the options of the first stand first.
        without: Names of settings whose option is left out.
        defaults: By a setting's name: the default that ``--help`` shows instead of the setting's.
    """
    settings = [s for command in commands for s in SETTINGS if s.option and s.command == command]

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        for setting in reversed([setting for setting in settings if setting.name not in without]):
            command = _option(setting, (defaults or {}).get(setting.name))(command)
        return command

    return decorate


def _option(setting: Setting, default: str | None) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    if default is None:
        default = setting.shown_default or ("" if setting.is_switch or setting.is_list else str(setting.default))
    shown = setting.help + (" Repeatable." if setting.is_list else "")
    return click.option(
        setting.option,
        is_flag=setting.is_switch,
        default=None,
        multiple=setting.is_list,
        metavar=None if setting.is_switch else setting.type.metavar,
        help=f"{shown} [default: {default}]" if default else shown,
    )
