"""What the program tells of itself: release, commit and formats (``rmpa --version``), and the script for shells."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Final

import click

import rmpa
from rmpa.cli.main import cli, verb


def long_version() -> str:
    """The version with the commit: what the build wrote down, else what git says of the clone."""
    if rmpa.COMMIT:
        return f"{rmpa.VERSION} ({rmpa.COMMIT}, {rmpa.DATE})"
    source = Path(rmpa.__file__).parents[1]
    script = source.with_name("scripts") / "version"
    if source.name != "src" or not script.exists():
        return rmpa.__version__
    import runpy

    names = runpy.run_path(str(script))
    return str(names["long"](*names["build"]()))


def about() -> dict[str, object]:
    """What a bug report should tell: ``rmpa --version --json``."""
    import platform

    libc, libc_version = platform.libc_ver()
    return {
        "version": long_version(),
        "protocols": {name: number for name, (number, _) in protocols().items()},
        "python": platform.python_version(),
        "libc": f"{libc} {libc_version}",
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
    }


# The number of each format that other programs or later runs read: its module, its name there, and what has it.
_FORMATS: Final = {
    "beacon": ("discovery.beacon", "VERSION", "how modules find each other (UDP)"),
    "link": (
        "mesh.frames",
        "VERSION",
        "how modules speak with each other (TCP): handshake, frames, control messages",
    ),
    "secured link": ("trust.store", "ALPN_LINK", "links with trust on, inside TLS 1.3"),
    "join": ("trust.store", "ALPN_JOIN", "`rmpa trust join` and renewals"),
    "beacon proof": ("trust.packets", "FORMAT", "the trailer of beacons with trust on"),
    "join token": ("trust.tokens", "FORMAT", "what `rmpa trust invite` prints"),
    "sites": ("gateway.sites.keys", "VERSION", "gateways over Zenoh: keys, tokens, attachments"),
    "monitor": ("web.monitor.messages", "SUBPROTOCOL", "the pages of `rmpa web`"),
    "REST": ("web.api", "PREFIX", "the JSON of `rmpa web`"),
    "resource": ("ros.types.descriptor", "VERSION", "the descriptor of a Smart Resource, a topic"),
    "core file": ("ros.core.state", "FORMAT", "`core-PORT.state`: registrations and parameters over a restart"),
    "resource file": ("resource.saved", "FORMAT", "`RESOURCE.json`: what a Smart Resource keeps"),
}


def protocols() -> dict[str, tuple[int | str, str]]:
    """The number of each format of the rooms that are installed, and what has it.

    docs/reference/compatibility.md shows them of each release; tests/golden has bytes of each.
    """
    return {
        name: (getattr(import_module(f"rmpa.{module}"), number), about)
        for name, (module, number, about) in _FORMATS.items()
        if (Path(rmpa.__file__).parent / module.partition(".")[0]).is_dir()
    }


_BASH: Final = """\
%(complete_func)s() {
    local IFS=$'\\n' line=${COMP_LINE:0:COMP_POINT} words current number reply
    # bash takes PEER:/name for three words. These are those of the line, up to the cursor.
    IFS=' ' read -ra words <<< "$line"
    [[ $line == *' ' ]] && words+=('')
    current=${words[-1]}
    COMPREPLY=()
    number=$((${#words[@]} - 1))
    for reply in $(env COMP_WORDS="${words[*]}" COMP_CWORD=$number %(complete_var)s=bash_complete $1); do
        case ${reply%%%%,*} in
            dir) compopt -o dirnames ;;
            file) compopt -o default ;;
            *) reply=${reply#*,}
               [[ $current == *:* ]] && reply=${reply#"${current%%:*}:"}
               COMPREPLY+=("$reply") ;;
        esac
    done
}
complete -o nosort -F %(complete_func)s %(prog_name)s
"""


@verb(click.argument("shell", type=click.Choice(["bash", "zsh", "fish"])))
def completion(shell: str) -> None:
    """Print the script that completes commands, options, and the names that the agent knows, in a shell.

    ---

    Examples:
      eval "$(rmpa completion bash)"             in this shell; in ~/.bashrc for all
      rmpa completion zsh > "${fpath[1]}/_rmpa"
      mkdir -p ~/.config/fish/completions
      rmpa completion fish > ~/.config/fish/completions/rmpa.fish
    """
    from click.shell_completion import BashComplete, get_completion_class

    kind = get_completion_class(shell)
    assert kind is not None  # noqa: S101 - each of the choices has one
    # ``source()`` of bash's class would run bash to check its version; the template needs no shell.
    complete = kind(cli, {}, "rmpa", "_RMPA_COMPLETE")
    template = _BASH if isinstance(complete, BashComplete) else complete.source_template
    click.echo(template % complete.source_vars())
