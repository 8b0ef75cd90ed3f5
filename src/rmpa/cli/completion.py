"""``rmpa completion``: prints click's own scripts for shell completion."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

EPILOG = """\
\b
Examples:
  rmpa completion bash > ~/.local/share/bash-completion/completions/rmpa
  rmpa completion zsh > "${fpath[1]}/_rmpa"
  rmpa completion fish > ~/.config/fish/completions/rmpa.fish
"""


@click.command(epilog=EPILOG)
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> None:
    """Print the script that completes rmpa's commands in a shell."""
    from rmpa.cli.main import cli

    kind = get_completion_class(shell)
    assert kind is not None  # noqa: S101 - each of the choices has one
    # ``source()`` of bash's class would run bash to check its version; the template needs no shell.
    complete = kind(cli, {}, "rmpa", "_RMPA_COMPLETE")
    click.echo(complete.source_template % complete.source_vars())
