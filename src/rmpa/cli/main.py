"""The program ``rmpa``: finds the command, runs it, and turns its result into an exit code.

Exit codes: 0 success; 1 failure, with the reason on stderr; 2 a usage error (a flag, a variable, a line of
``rmpa.toml``); 130 after Ctrl-C and 141 after a closed pipe, as in shells.

With ``--json`` an error is also one JSON object on stdout, ``{"error": text}``, so that a program that reads stdout
never finds it empty.
"""

from __future__ import annotations

import os
import sys
from itertools import takewhile
from typing import TYPE_CHECKING

import click

from rmpa import __version__
from rmpa.cli.lazy_group import LazyGroup, PipeClosed
from rmpa.core.errors import ConfigError, RmpaError

if TYPE_CHECKING:
    from collections.abc import Sequence

_GROUPS = "rmpa.cli.groups"
COMMANDS = {
    "up": ("rmpa.cli.up", "Run this machine's agent: ROS core, discovery, mesh and bridge."),
    "core": ("rmpa.cli.core", "Run the ROS core alone: a drop-in for roscore."),
    "run": ("rmpa.cli.run", "Run the Smart Resources of a Python file, with the agent of their module."),
    "peer": (_GROUPS, "See the peers that the agent knows."),
    "topic": (_GROUPS, "See topics, listen to them, publish on them."),
    "service": (_GROUPS, "See services, and call them."),
    "node": (_GROUPS, "See nodes, here and in other modules; ping and end them."),
    "param": (_GROUPS, "See and set parameters, here or at a peer."),
    "resource": (_GROUPS, "See Smart Resources, here or at a peer."),
    "profile": (_GROUPS, "See and choose the System Profile of a resource."),
    "context": (_GROUPS, "See and choose the context of a resource."),
    "alarm": (_GROUPS, "See the alarms of resources."),
    "site": (_GROUPS, "See other sites that gateways join, and values of modules that are off."),
    "trust": (_GROUPS, "Secure the mesh: who may join, and what other modules may do here."),
    "why": ("rmpa.cli.why", "Say why a topic of a peer does not arrive, and what to do."),
    "doctor": ("rmpa.cli.doctor", "Check this machine: network, clock, rights, ROS environment."),
    "web": ("rmpa.cli.web", "Serve this module's state over HTTP: metrics, REST."),
    "gateway": ("rmpa.cli.gateway", "Join this network's modules with other sites and with ROS 2, over Zenoh."),
    "config": ("rmpa.cli.config", "Show the settings and where each comes from; print their JSON Schema."),
    "reload": ("rmpa.cli.reload", "Let the agent read its settings again."),
    "completion": ("rmpa.cli.completion", "Print the script that completes rmpa's commands in a shell."),
}
MEANT = {
    "help": ("--help",),
    "version": ("--version",),
    "start": ("up",),
    "roscore": ("core",),
    "status": ("peer list", "doctor"),
    "check": ("doctor",),
    "list": ("peer list", "topic list"),
    "info": ("peer info", "topic info"),
    "ping": ("peer ping", "node ping"),
    "echo": ("topic echo",),
    "pub": ("topic pub",),
    "hz": ("topic hz",),
    "bw": ("topic bw",),
    "delay": ("topic delay",),
    "call": ("service call",),
    "get": ("param get",),
    "set": ("param set",),
    "join": ("trust join",),
    "invite": ("trust invite",),
}
"""Words that are no commands of ``rmpa``, and what a user who writes them wants."""
EPILOG = """\
\b
Examples:
  rmpa up --name base            the agent of this machine
  rmpa peer list                 who is there
  rmpa topic list                what they have to say
  rmpa topic echo joystick:/cmd  one peer's messages
  rmpa why joystick:/cmd         why they do not come
"""


@click.group(
    cls=LazyGroup,
    commands_at=COMMANDS,
    meant=MEANT,
    epilog=EPILOG,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, "--version", "-V", message="rmpa %(version)s")
def cli() -> None:
    """ROS 1 modules with a core of their own that share topics, with no master between them."""
    if os.environ.get("NO_COLOR"):  # no-color.org; without it click colours what a terminal shows
        click.get_current_context().color = False


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line: the entry point of the console script. Returns the exit code.

    Args:
        arguments: Without the program's name; ``sys.argv`` by default.
    """
    try:
        code = _run(arguments)
        sys.stdout.flush()
    except (BrokenPipeError, PipeClosed):
        # The reader has closed the pipe (`| head`). The rest of the buffer must not fail again when Python exits.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    return code


def _run(arguments: Sequence[str] | None) -> int:
    try:
        code = cli.main(args=arguments, prog_name="rmpa", standalone_mode=False)
    except click.ClickException as error:
        if isinstance(error, click.NoSuchOption):
            from rmpa.config.schema import REMOVED

            if remedy := REMOVED.get(error.option_name):
                error = click.UsageError(f"No such option: {error.option_name}; {remedy}", error.ctx)
        error.show()
        return _failed(arguments, error.format_message(), error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        return 130
    except RmpaError as error:
        from rmpa.cli.output import print_error

        print_error(error)
        return _failed(arguments, str(error), 2 if isinstance(error, ConfigError) else 1)
    return code if isinstance(code, int) else 0


def _failed(arguments: Sequence[str] | None, text: str, code: int) -> int:
    """Print an error as JSON too if ``--json`` was given; return the exit code."""
    if wants_json(sys.argv[1:] if arguments is None else arguments):
        from rmpa.cli.output import print_json  # it imports msgspec, which --help does without

        print_json({"error": text})
    return code


def wants_json(arguments: Sequence[str]) -> bool:
    """Whether a command line has ``--json``; click may have failed before it parsed that."""
    return "--json" in takewhile(lambda argument: argument != "--", arguments)


if __name__ == "__main__":
    sys.exit(main())
