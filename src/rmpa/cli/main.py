"""The program ``rmpa``: all commands and groups, each imported when it is used.

The groups of commands: ``rmpa topic``, ``rmpa node`` and so on, with the module of each command.
"""

from __future__ import annotations

import importlib
import os
import sys
from itertools import takewhile
from typing import TYPE_CHECKING, Final

import click

from rmpa import __version__
from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, RmpaError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


# A group of commands, each imported when it is called: ``rmpa --help`` stays quick.


REMOVED_VERBS: Final = {
    "experiment": "in a clone of the repository: make experiment, or python -m lab experiment (docs/experiments.md)",
    "multicast": "`rmpa doctor --listen 30` on one machine and `rmpa doctor` on the other try multicast between them",
    "resource history": "record it: rosbag record /SONAR/decision /SONAR/quality /SONAR/alarms",
    "site last": "record the topic with rosbag where it is needed, or keep its key by a storage of Zenoh",
    "trust import": "write [[permission]] tables into rmpa.toml: docs/permissions.md",
}
"""What to use in place of a command that is gone, by its words behind ``rmpa``."""


class PipeClosed(Exception):  # noqa: N818 - not an error: the program that reads our output has closed the pipe
    """Standard output was closed; click would turn the BrokenPipeError into an exit of its own."""


class LazyGroup(click.Group):
    """A click group whose commands are imported on use.

    Click shows a command's help line by importing it, and suggests the nearest command only since 8.4; this class
    does both from the table alone.

    Args:
        commands_at: By name: the module, which has the command under that name (or with ``_`` behind it, where the
            name is a builtin's), and the line that the group's help shows.
        meant: By a word that is no command: what a user who writes it wants, a command line without the program.
        arguments: For ``click.Group``.
    """

    def __init__(
        self,
        *,
        commands_at: Mapping[str, tuple[str, str]],
        meant: Mapping[str, Sequence[str]] | None = None,
        **arguments: object,
    ) -> None:
        super().__init__(**arguments)  # type: ignore[arg-type] # handed through as they came
        self.commands_at = commands_at
        self.meant = meant or {}

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        """The names, in the order of the table."""
        return list(self.commands_at)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002 - click's signature
        """Import one command, or ``None``."""
        if cmd_name not in self.commands_at:
            return None
        module = importlib.import_module(self.commands_at[cmd_name][0])
        command = getattr(module, cmd_name.replace("-", "_"), None)
        if not isinstance(command, click.Command):
            command = getattr(module, f"{cmd_name}_")
        assert isinstance(command, click.Command)  # noqa: S101 - a mistake in our own table
        return command

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the group's own options; for one of a command the error says where it stands.

        Raises:
            click.NoSuchOption: The group has no such option.
        """
        words = [*args]
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            path = [ctx.command_path]
            found: click.Command = self
            for word in words:
                if isinstance(found, LazyGroup) and word in found.commands_at:
                    path.append(word)
                    found = found.get_command(ctx, word) or found
            if any(error.option_name in each.opts for each in found.params):
                ctx.fail(f"{error.option_name} stands behind the command: {' '.join(path)} {error.option_name}")
            raise

    def invoke(self, ctx: click.Context) -> object:
        """Run the command.

        Raises:
            PipeClosed: Standard output was closed by its reader.
        """
        try:
            return super().invoke(ctx)
        except BrokenPipeError as error:
            raise PipeClosed from error

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find a command; for a misspelt one the error names the nearest."""
        if args:
            words = " ".join((*ctx.command_path.split()[1:], args[0]))
            if remedy := REMOVED_VERBS.get(words):
                raise ConfigError(f"rmpa {words}", "is not a command any more", remedy)
        if args and args[0] not in self.commands_at and not args[0].startswith("-"):
            near = did_you_mean(args[0], self.commands_at)
            others = self.meant.get(args[0]) or ([near] if near else [])
            named = " or ".join(f"`{ctx.command_path} {other}`" for other in others)
            hint = f"Did you mean {named}?" if others else f"There are {', '.join(self.commands_at)}."
            ctx.fail(f"No such command {args[0]!r}. {hint}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002 - click's
        """Write the table's lines, without importing anything."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in self.commands_at.items()])


_MASTER: Final = """\
The master: --master, else the core of --agent (or RMPA_AGENT), else ROS_MASTER_URI, else the core of the only
agent of this machine, else http://localhost:11311.
"""
_RESOURCE: Final = (
    "\b\nA resource is written as its node, /sonar; PEER:/sonar is that peer's. See rmpa resource --help.\n"
)


def _group(help_text: str, modules: Sequence[tuple[str, Mapping[str, str]]], epilog: str = "") -> LazyGroup:
    """A group of commands.

    Args:
        help_text: What ``--help`` of the group shows.
        modules: By module of ``rmpa.cli``: its commands, each with the line that the group's help shows.
        epilog: Shown behind the commands.
    """
    commands_at = {
        name: (f"rmpa.cli.{module}", line) for module, commands in modules for name, line in commands.items()
    }
    return LazyGroup(commands_at=commands_at, help=help_text, epilog=epilog)


peer: Final = _group(
    "See the peers that the agent knows.",
    [
        (
            "peer",
            {
                "list": "List the peers, and how their links are.",
                "info": "Show all that is known of one peer.",
                "ping": "Measure the round trip to a peer over the mesh.",
            },
        )
    ],
)
topic: Final = _group(
    "See topics, listen to them, publish on them; no ROS installation is needed.",
    [
        (
            "topic",
            {
                "list": "List topics; those of peers with the peers' names.",
                "info": "Show a topic's type, publishers and subscribers, and what of it crosses.",
                "type": "Print a topic's type.",
                "find": "Print the topics of a type.",
            },
        ),
        ("topic_echo", {"echo": "Print messages."}),
        (
            "topic_echo",
            {
                "hz": "Show how often messages come.",
                "bw": "Show how many bytes they need.",
                "delay": "Show how old they are when they come; over the mesh by the link's clock too.",
            },
        ),
        ("messages", {"pub": "Publish messages."}),
    ],
    f"\b\nA topic is written /name; PEER:/name means the sources of one peer alone.\n{_MASTER}",
)
service: Final = _group(
    "See services, and call them; no ROS installation is needed.",
    [
        (
            "service",
            {
                "list": "List services; those of peers with the peers' names.",
                "info": "Show a service's node, address, type and arguments, and what of it crosses.",
                "type": "Print a service's type.",
                "find": "Print the services of a type.",
            },
        ),
        ("service", {"call": "Call a service."}),
    ],
    f"\b\nA service is written /name; PEER:/name means the service of that peer alone.\n{_MASTER}",
)
node: Final = _group(
    "See nodes, here and in other modules; ping and end them. No ROS installation is needed.",
    [
        (
            "node",
            {
                "list": "List nodes; those of peers as PEER:/node.",
                "info": "Show a node's module, address, process, topics and services.",
            },
        ),
        ("node", {"ping": "Ask whether a node answers, and how fast.", "kill": "End nodes."}),
    ],
    "\b\nA node is written /name; PEER:/name means that one peer's. A proxy's name, /rmpa/PEER/name, means the "
    f"same.\n{_MASTER}",
)
param: Final = _group(
    "See and set parameters, here or at a peer; no ROS installation is needed.",
    [
        (
            "param",
            {
                "get": "Print a parameter, or a namespace of them.",
                "set": "Set a parameter, or the members of a namespace.",
                "list": "List the names of parameters.",
                "delete": "Delete a parameter, or a namespace of them.",
                "dump": "Write parameters as YAML.",
                "load": "Set parameters from YAML.",
                "followed": "List the parameters of other modules that this one follows ([[param]]).",
            },
        )
    ],
    """\
\b
With --peer the parameters of that peer's module are meant; its [params] say what others may read and set.
The master without it: --master, else the core of --agent (or RMPA_AGENT), else ROS_MASTER_URI, else the core of
the only agent of this machine, else http://localhost:11311. YAML is read and written as rosparam does.
""",
)
resource: Final = _group(
    "See Smart Resources, here or at a peer.",
    [
        ("resource", {"list": "List resources; those of peers with the peers' names."}),
        ("profile", {"info": "Show all of a resource: topics, parameters, qualities, profiles, contexts, clients."}),
    ],
    "\b\nA resource is written as its node, /sonar; PEER:/sonar is that peer's. It may be left out where there is "
    f"only one.\n{_MASTER}",
)
profile: Final = _group(
    "See and choose the System Profile of a resource, here or at a peer.",
    [
        (
            "profile",
            {
                "list": "List a resource's profiles and what they offer.",
                "get": "Print the profile that runs.",
                "set": "Choose a profile by hand, or let the resource decide again.",
                "explain": "Show each term of the last decision.",
            },
        )
    ],
    _RESOURCE,
)
context: Final = _group(
    "See and choose the context of a resource, here or at a peer.",
    [
        (
            "run",
            {
                "list": "List a resource's contexts, their rules and what they require.",
                "get": "Print the present context; an empty line for none.",
                "set": "Choose a context by hand, or let the rules decide again.",
            },
        )
    ],
    _RESOURCE,
)
alarm: Final = _group(
    "See the alarms of resources, here and at peers.",
    [
        (
            "messages",
            {
                "list": "List the resources that are not well at present.",
                "echo": "Print alarms as they are raised and cleared, until Ctrl-C.",
            },
        )
    ],
    _RESOURCE,
)
site: Final = _group(
    "See other sites that gateways join.",
    [
        (
            "site",
            {
                "list": "List this site and the others, and how they are.",
                "info": "Show the modules of a site and what they offer.",
            },
        )
    ],
    """\
\b
Any module of a site can ask: the gateways that it is linked to answer.
Parameters of another site's module: `rmpa param get --peer SITE/MODULE /name`.
Why something does not come from a site: `rmpa why /name`.
""",
)
trust: Final = _group(
    "Secure the mesh: who may join, and what other modules may do here.",
    [
        (
            "trust",
            {
                "init": "Make a secured mesh, with this module as its authority.",
                "status": "Show certificate, keys and deny list; at the authority members and tokens.",
                "renew": "Renew the certificate now, or the group key of all.",
                "revoke": "Throw a module out of the mesh, at the authority.",
                "leave": "Remove this module's keys and certificate.",
            },
        ),
        (
            "trust_join",
            {
                "invite": "Invite a module, at the authority: print a token, and wait.",
                "join": "Join a secured mesh with a token, or by files.",
            },
        ),
        (
            "trust",
            {
                "check": "Say whether a peer may do something here, and by which rule.",
            },
        ),
    ],
    "\b\nA walk-through, a fleet's provisioning, and what to do when keys are lost: docs/trust.md\n",
)


# The program ``rmpa``: finds the command, runs it, and turns its result into an exit code.
#
# Exit codes: 0 success; 1 failure, with the reason on stderr; 2 a usage error (a flag, a variable, a line of
# ``rmpa.toml``); 130 after Ctrl-C and 141 after a closed pipe, as in shells.
#
# With ``--json`` an error is also one JSON object on stdout, ``{"error": text}``, so that a program that reads
# stdout
# never finds it empty.


_GROUPS = "rmpa.cli.main"
COMMANDS = {
    "up": ("rmpa.cli.agent", "Run this machine's agent: ROS core, discovery, mesh and bridge."),
    "core": ("rmpa.cli.gateway", "Run the ROS core alone: a drop-in for roscore."),
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
    "why": ("rmpa.cli.agent", "Say why a topic of a peer does not arrive, and what to do."),
    "doctor": ("rmpa.cli.agent", "Check this machine: network, clock, rights, ROS environment."),
    "web": ("rmpa.cli.gateway", "Serve this module's state over HTTP: metrics, REST."),
    "gateway": ("rmpa.cli.gateway", "Join this network's modules with other sites and with ROS 2, over Zenoh."),
    "config": ("rmpa.cli.agent", "Show the settings and where each comes from; print their JSON Schema."),
    "reload": ("rmpa.cli.agent", "Let the agent read its settings again."),
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
    # By its name: in ``__main__`` its classes would exist twice.
    sys.exit(importlib.import_module("rmpa.cli.main").main())
