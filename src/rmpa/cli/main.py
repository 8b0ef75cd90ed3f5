"""The program ``rmpa``: its verbs, each imported when it is used, and how a result becomes an exit code.

Exit codes: 0 success; 1 failure, with the reason on stderr; 2 a usage error (a flag, a variable, a line of
``rmpa.toml``); 130 after Ctrl-C and 141 after a closed pipe, as in shells.

With ``--json`` an error is also one JSON object on stdout, ``{"error": text, "code": code}``, so that a program that
reads stdout never finds it empty. Codes are those of ``core.codes``.
"""

from __future__ import annotations

import importlib
import inspect
import os
import re
import sys
from itertools import takewhile
from typing import TYPE_CHECKING, Any, Final, TypeVar

import click

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, RmpaError, with_places

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from importlib.metadata import EntryPoint

_Function = TypeVar("_Function", bound="Callable[..., Any]")
# By the words behind ``rmpa``: the module of ``rmpa.cli``, and the line that the help of the group shows.
#
# ``rmpa topic list`` is the function ``topic_list`` of its module.
_DECLARED: Final = {
    "up": ("agent", "Run this machine's agent: ROS core, discovery, mesh and bridge."),
    "init": ("init", "Write a first rmpa.toml, from what is found on this machine."),
    "core": ("core", "Run the ROS core alone: a drop-in for roscore."),
    "run": ("run", "Run Smart Resources, with the agent of their module."),
    "peer": ("main", "See the peers that the agent knows."),
    "peer list": ("peer", "List the peers and the state of their links."),
    "peer info": ("peer", "Show all that is known of one peer."),
    "peer ping": ("peer", "Measure the round trip to a peer over the mesh."),
    "topic": ("main", "See topics, listen to them, publish on them."),
    "topic list": ("topic", "List topics; those of peers with the peers' names."),
    "topic info": ("topic", "Show a topic's type, publishers and subscribers, and what crosses the mesh."),
    "topic type": ("topic", "Print a topic's type."),
    "topic find": ("topic", "Print the topics of a type."),
    "topic echo": ("messages", "Print messages."),
    "topic hz": ("topic", "Show the rate of messages."),
    "topic bw": ("topic", "Show the bandwidth of messages."),
    "topic delay": ("topic", "Show the age of messages when they arrive: by their stamps, and by the link's clock."),
    "topic pub": ("messages", "Publish messages."),
    "service": ("main", "See services, and call them; start rmpa at boot."),
    "service list": ("service", "List services; those of peers with the peers' names."),
    "service info": ("service", "Show a service's node, address, type and arguments, and what crosses the mesh."),
    "service type": ("service", "Print a service's type."),
    "service find": ("service", "Print the services of a type."),
    "service call": ("service", "Call a service."),
    "service install": ("boot", "Start the agent at boot, and now: by a unit of systemd."),
    "service status": ("boot", "Show whether rmpa's units of systemd run, and the end of their log."),
    "service uninstall": ("boot", "Stop rmpa, and do not start it at boot any more."),
    "node": ("main", "See nodes, here and in other modules; ping and end them; set the levels of their logs."),
    "node list": ("node", "List nodes; those of peers as PEER:/node."),
    "node info": ("node", "Show a node's module, address, process, topics and services."),
    "node ping": ("node", "Ask whether a node answers, and how fast."),
    "node kill": ("node", "End nodes."),
    "node log-level": ("node", "Show the levels of a node's loggers, and set one."),
    "top": ("launch", "Show the processes and topics of all modules: CPU, memory, rates."),
    "record": ("record", "Record what happens on this module; keep, fetch and merge recordings of all."),
    "record list": ("recordings", "List what the modules have kept, and what their recorders do."),
    "record info": ("recordings", "Show what is known of a recording."),
    "record keep": ("recordings", "Keep what all modules have of the last minutes."),
    "record fetch": ("recordings", "Fetch a recording from all modules that have it."),
    "record merge": ("recordings", "Put recordings of several modules on one timeline."),
    "record rm": ("recordings", "Remove a recording."),
    "play": ("play", "Play a recording into this module's core."),
    "diff": ("play", "Compare two recordings, topic by topic."),
    "story": ("play", "Say what happened in a recording."),
    "log": ("log", "Show the log of the nodes and agents of all modules, in one order."),
    "param": ("main", "See and set parameters, here or at a peer."),
    "param get": ("param", "Print a parameter, or a namespace of them."),
    "param set": ("param", "Set a parameter, or the members of a namespace."),
    "param list": ("param", "List the names of parameters."),
    "param delete": ("param", "Delete a parameter, or a namespace of them."),
    "param dump": ("param", "Write parameters as YAML."),
    "param load": ("param", "Set parameters from YAML."),
    "param followed": ("param", "List the parameters of other modules that this one follows ([[param]])."),
    "resource": ("main", "See Smart Resources, here or at a peer; start and stop them."),
    "resource list": ("resource", "List resources; those of peers with the peers' names."),
    "resource info": (
        "profile",
        "Show all of a resource: topics, parameters, qualities, profiles, contexts, clients.",
    ),
    "resource describe": ("describe", "Write a first description of a resource from a live node."),
    "resource check": ("describe", "Compare the description of a resource with the live graph."),
    "resource schema": ("describe", "Print the JSON Schema of descriptions: editors check and complete them."),
    "resource start": ("launch", "Start a resource of a module's folder."),
    "resource stop": ("launch", "End a resource, with the nodes that it has started."),
    "resource restart": ("launch", "End a resource and start it again."),
    "resource log": ("launch", "Show what a resource and its nodes have written."),
    "profile": ("main", "See and choose the System Profile of a resource."),
    "profile list": ("profile", "List a resource's profiles and what they offer."),
    "profile get": ("profile", "Print the profile that runs."),
    "profile set": ("profile", "Choose a profile by hand, or let the resource decide again."),
    "profile explain": ("profile", "Show each term of the last decision."),
    "context": ("main", "See and choose the context of a resource."),
    "context list": ("profile", "List a resource's contexts, their rules and what they require."),
    "context get": ("profile", "Print the present context; an empty line for none."),
    "context set": ("profile", "Choose a context by hand, or let the rules decide again."),
    "alarm": ("main", "See the alarms of resources."),
    "alarm list": ("resource", "List the resources that have a problem."),
    "alarm echo": ("resource", "Print alarms as they are raised and cleared, until Ctrl-C."),
    "diagnostics": ("diagnostics", "Show what the nodes of all modules say on /diagnostics."),
    "site": ("main", "See other sites that gateways join."),
    "site list": ("peer", "List this site and the others, with their state."),
    "site info": ("peer", "Show the modules of a site and what they offer."),
    "trust": ("main", "Secure the mesh: who may join, and what other modules may do here."),
    "trust init": ("trust", "Make a secured mesh, with this module as its authority."),
    "trust status": ("trust", "Show certificate, keys and deny list; at the authority members and tokens."),
    "trust renew": ("trust", "Renew the certificate now, or the group key of all."),
    "trust revoke": ("trust", "Exclude a module from the mesh, at the authority."),
    "trust leave": ("trust", "Remove this module's keys and certificate."),
    "trust invite": ("trust", "Invite a module, at the authority: print a token, and wait."),
    "trust join": ("trust", "Join a secured mesh with a token, or by files."),
    "trust check": ("trust", "Say whether a peer may do something here, and by which rule."),
    "why": ("agent", "Say why a topic of a peer does not arrive, and what to do."),
    "explain": ("agent", "Say what the code of an error or a warning means, and what to do."),
    "doctor": ("doctor", "Check this machine: network, clock, rights, ROS environment."),
    "bug-report": ("bug_report", "Collect what a maintainer needs to know of this machine, redacted."),
    "web": ("web", "Serve the mesh's pages, rosbridge, Foxglove, REST and metrics over HTTP."),
    "gateway": ("gateway", "Join this network's modules with other sites over Zenoh, and with ROS 2."),
    "gateway zenoh-config": ("gateway", "Print a configuration for zenohd, Zenoh's own router."),
    "config": ("main", "Show the settings and where each comes from; print their JSON Schema."),
    "config show": ("agent", "Print each setting that `rmpa up` would use here, and where it comes from."),
    "config schema": ("agent", "Print the JSON Schema of rmpa.toml: editors check and complete the file with it."),
    "reload": ("agent", "Let the agent read its settings again."),
    "completion": ("program", "Print the script that completes rmpa's commands in a shell."),
}
_FAMILIES: Final = {file.removesuffix(".py") for file in os.listdir(os.path.dirname(__file__))}  # noqa: PTH208, PTH120
_OWN: Final = {words for words, (module, _) in _DECLARED.items() if module in _FAMILIES and module != "main"}
# Those whose module is installed, and the groups of these.
VERBS: Final = {
    words: about
    for words, about in _DECLARED.items()
    if words in _OWN or any(each.startswith(f"{words} ") for each in _OWN)
}
# Words that are no commands of ``rmpa``, and what a user who writes them wants.
MEANT: Final = {
    "help": ("--help",),
    "version": ("--version",),
    "start": ("up", "resource start", "service install"),
    **{word: (f"service {word}",) for word in ("install", "uninstall")},
    "enable": ("service install",),
    "roscore": ("core",),
    "status": ("service status", "peer list", "doctor"),
    "check": ("doctor",),
    "report": ("bug-report",),
    "launch": ("resource start", "run"),
    **{word: (f"resource {word}",) for word in ("stop", "restart")},
    "ps": ("top", "node list"),
    "list": ("peer list", "topic list"),
    "info": ("peer info", "topic info"),
    "ping": ("peer ping", "node ping"),
    "get": ("param get",),
    "set": ("param set",),
    "call": ("service call",),
    **{word: (f"topic {word}",) for word in ("echo", "pub", "hz", "bw", "delay")},
    **{word: (f"trust {word}",) for word in ("join", "invite")},
}
_MASTER: Final = """\
The master: --master, else the core of --agent (or RMPA_AGENT), else ROS_MASTER_URI, else the core of the only
agent of this machine, else http://localhost:11311."""


class PipeClosed(Exception):  # noqa: N818 - not an error: the program that reads our output has closed the pipe
    """Standard output was closed; click would turn the BrokenPipeError into an exit of its own."""


def help_of(docstring: str | None) -> dict[str, Any]:
    """Help text and epilog of a command, for click: its docstring, parted at a line ``---``.

    The paragraphs of the epilog are shown as they are written.
    """
    text, _, epilog = inspect.cleandoc(docstring or "").partition("\n---\n")
    paragraphs = epilog.replace("{master}", _MASTER).strip().split("\n\n") if epilog else ()
    return {"help": text, "epilog": "\n\n".join(f"\b\n{each}" for each in paragraphs)}


class PlacedHelp(click.Command):
    """A command whose help fits the terminal, and says where the pages are that it names."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002 - click's
        """Write the epilog: sentences are filled; where a line is too long, what an example does stands below it."""
        for paragraph in with_places(self.epilog or "").replace("\b\n", "").strip("\n").split("\n\n"):
            lines = paragraph.splitlines()
            examples = [line for line in lines if line.startswith(" ")]
            formatter.write_paragraph()
            with formatter.indentation():
                formatter.write_text(" ".join(line for line in lines if not line.startswith(" ")))
                room = formatter.width - formatter.current_indent
                for line in shown_examples(examples, room):
                    formatter.write(f"{'':>{formatter.current_indent}}{line}\n")


def shown_examples(lines: Sequence[str], width: int) -> Iterator[str]:
    """Examples, each ``  command   what it does``, in so many columns.

    Where one is longer, each has below it what it does. A command that is longer itself stays one line, to be copied.
    """
    parts = [re.fullmatch(r"( *.*?\S)(?: {2,}(\S.*))?", line) for line in lines]
    if all(len(line) <= width for line in lines):
        yield from lines
        return
    for part in parts:
        if part is not None:
            yield part[1]
            if part[2]:
                yield from click.wrap_text(part[2], width, "      ", "      ").splitlines()


class LazyGroup(PlacedHelp, click.Group):
    """A click group whose commands are imported on use: ``rmpa --help`` stays quick.

    Click shows a command's help line by importing it, and suggests the nearest command only since 8.4; this class
    does both from the table of verbs alone.

    Args:
        path: The words behind ``rmpa``.
        help: As for ``help_of``.
        arguments: For ``click.Group``.
    """

    def __init__(self, *, path: str = "", help: str | None, **arguments: Any) -> None:  # noqa: A002 - click's name
        super().__init__(**help_of(help), **arguments)
        self._path = path
        parted = [(words.rpartition(" "), about) for words, about in VERBS.items()]
        self.commands_at = {name: about for (group, _, name), about in parted if group == path}

    def _plugins(self) -> dict[str, EntryPoint]:
        """Commands that packages of others add to ``rmpa``."""
        if self._path:
            return {}
        from rmpa.runtime import plugins

        found = plugins.find_plugins(plugins.VERBS)
        return {name: found[name] for name in sorted(found) if name not in self.commands_at}

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        """The names, in the order of the table, then those of other packages."""
        return [*self.commands_at, *self._plugins()]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import one command, or ``None``.

        Raises:
            RmpaError: It is of another package, which is broken; a shell that completes has ``None`` instead.
        """
        if cmd_name not in self.commands_at:
            return self._plugin(cmd_name, quiet=ctx.resilient_parsing)
        module = importlib.import_module(f"rmpa.cli.{self.commands_at[cmd_name][0]}")
        command = getattr(module, f"{self._path} {cmd_name}".strip().replace(" ", "_").replace("-", "_"))
        assert isinstance(command, click.Command)  # noqa: S101 - a mistake in our own table
        return command

    def _plugin(self, name: str, *, quiet: bool) -> click.Command | None:
        entry = self._plugins().get(name)
        if entry is None:
            return None
        from rmpa.runtime.plugins import load_plugin, plugin_error

        try:
            command = load_plugin(entry)
            if not isinstance(command, click.Command):
                raise plugin_error(entry, TypeError(f"{entry.value} is no click.Command"))
        except RmpaError:
            if quiet:
                return None
            raise
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
            if found is not self and any(error.option_name in each.opts for each in found.params):
                ctx.fail(f"{error.option_name} belongs after the command: {' '.join(path)} {error.option_name}")
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
        word = args[0] if args else "-"
        if word not in self.commands_at and not word.startswith("-") and word not in self._plugins():
            near, meant = did_you_mean(word, self.commands_at), () if self._path else MEANT.get(word, ())
            others = [each for each in meant if each in VERBS or each[0] == "-"] or ([near] if near else [])
            named = " or ".join(f"`{ctx.command_path} {other}`" for other in others)
            hint = f"Did you mean {named}?" if others else f"There are {', '.join(self.commands_at)}."
            ctx.fail(f"No such command {word!r}. {hint}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002 - click's
        """Write the table's lines, without importing a command."""
        lines = [(name, text) for name, (_, text) in self.commands_at.items()]
        if others := self._plugins():
            from rmpa.runtime.plugins import package_of

            lines += [(name, f"Of the package {package_of(entry)}.") for name, entry in others.items()]
        with formatter.section("Commands"):
            formatter.write_dl(lines)


def decorated(function: _Function, parameters: Sequence[Callable[[_Function], _Function]]) -> _Function:
    """A function with these arguments and options of click, which its help shows in this order."""
    for parameter in reversed(parameters):
        function = parameter(function)
    return function


def verb(*parameters: Callable[..., Any], **settings: Any) -> Callable[[Callable[..., Any]], click.Command]:
    """Make a command of a function: ``help_of`` its docstring, and these arguments and options in order."""

    def decorate(function: Callable[..., Any]) -> click.Command:
        made = click.command(cls=PlacedHelp, **help_of(function.__doc__), **settings)
        return made(decorated(function, parameters))

    return decorate


def _group(function: Callable[[], None]) -> LazyGroup:
    return LazyGroup(path=function.__name__, help=function.__doc__)


@_group
def peer() -> None:
    """See the peers that the agent knows."""


@_group
def topic() -> None:
    """See topics, listen to them, publish on them; no ROS installation is needed.

    ---
    A topic is written /name; PEER:/name means the sources of one peer alone.
    {master}
    """


@_group
def service() -> None:
    """See services of ROS, and call them; no ROS installation is needed. Start rmpa at boot.

    ---
    At boot, as a service of systemd: install, status, uninstall.
    A service of ROS is written /name; PEER:/name means the service of that peer alone.
    {master}
    """


@_group
def node() -> None:
    """See nodes, here and in other modules; ping and end them. No ROS installation is needed.

    ---
    A node is written /name; PEER:/name means that one peer's. A proxy's name, /rmpa/PEER/name, means the same.
    {master}
    """


@_group
def param() -> None:
    """See and set parameters, here or at a peer; no ROS installation is needed.

    ---
    With --peer the parameters of that peer's module are meant; its [params] say what others may read and set.
    The master without it: --master, else the core of --agent (or RMPA_AGENT), else ROS_MASTER_URI, else the core of
    the only agent of this machine, else http://localhost:11311. YAML is read and written as rosparam does.
    """


@_group
def resource() -> None:
    """See Smart Resources, here or at a peer; start and stop them.

    ---
    A resource is written as its node, /sonar; PEER:/sonar is that peer's. It may be left out where there is only one.
    What can be started lies in the folder of [resources] of each module's rmpa.toml, one file a resource.
    {master}
    """


@_group
def profile() -> None:
    """See and choose the System Profile of a resource, here or at a peer.

    ---
    A resource is written as its node, /sonar; PEER:/sonar is that peer's. See rmpa resource --help.
    """


@_group
def context() -> None:
    """See and choose the context of a resource, here or at a peer.

    ---
    A resource is written as its node, /sonar; PEER:/sonar is that peer's. See rmpa resource --help.
    """


@_group
def alarm() -> None:
    """See the alarms of resources, here and at peers.

    ---
    A resource is written as its node, /sonar; PEER:/sonar is that peer's. See rmpa resource --help.
    """


@_group
def site() -> None:
    """See other sites that gateways join.

    ---
    Any module of a site can ask: the gateways that it is linked to answer.
    Why something does not come from a site: `rmpa why /name`.
    """


@_group
def trust() -> None:
    """Secure the mesh: who may join, and what other modules may do here.

    ---
    A walk-through, a fleet's provisioning, and what to do when keys are lost: docs/guides/trust.md#a-secured-mesh
    """


@_group
def config() -> None:
    """Show the settings and where each comes from; print their JSON Schema.

    ---

    Examples:
      rmpa config show                        what `rmpa up` would use, and from where
      rmpa config show --config new.toml      is this file right?
      rmpa config schema > rmpa.schema.json   for editors: see docs/reference/settings.md
    """


def _show_version(ctx: click.Context, _: click.Parameter, wanted: bool) -> None:
    """Print the version, with the commit that it was built of or that a clone has."""
    as_json = ctx.meta.get("--json")
    if as_json and not wanted:
        raise click.NoSuchOption("--json", ctx=ctx)
    if wanted:
        program = importlib.import_module("rmpa.cli.program")
        if as_json:
            from rmpa.cli.output import print_json

            print_json(program.about())
        else:
            click.echo(f"rmpa {program.long_version()}")
        ctx.exit()


def _note_json(ctx: click.Context, _: click.Parameter, wanted: bool) -> None:
    """Of the group's own options ``--version`` alone has JSON."""
    ctx.meta["--json"] = wanted


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.option("--json", is_flag=True, is_eager=True, expose_value=False, hidden=True, callback=_note_json)
@click.option(
    "-V",
    "--version",
    is_flag=True,
    expose_value=False,
    callback=_show_version,
    help="Show the version; with --json formats and system too.",
)
def cli() -> None:
    """ROS 1 modules with a core of their own that share topics, with no master between them.

    ---

    Examples:
      rmpa up --name base            the agent of this machine
      rmpa peer list                 the modules that are linked
      rmpa topic list                what they have to say
      rmpa topic echo joystick:/cmd  one peer's messages
      rmpa why joystick:/cmd         why they do not come
    """
    # no-color.org; without it click colours what a terminal shows.
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
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
    """Run it; an error is printed, as JSON too if ``--json`` was given."""
    try:
        done = cli.main(args=arguments, prog_name="rmpa", standalone_mode=False)
    except click.ClickException as error:
        text, code, status = error.format_message(), "usage", error.exit_code
        if isinstance(error, click.exceptions.NoArgsIsHelpError):
            click.echo(text, err=True)
        else:
            error.format_message = lambda: f"{text} [usage]"  # type: ignore[method-assign]
            error.show()
    except (click.Abort, KeyboardInterrupt):
        return 130
    except RmpaError as error:
        from rmpa.cli.output import print_error

        text, code, status = str(error), error.code, 2 if isinstance(error, ConfigError) else 1
        print_error(error, code)
    else:
        return done if isinstance(done, int) else 0
    if wants_json(sys.argv[1:] if arguments is None else arguments):
        from rmpa.cli.output import print_json  # it imports msgspec, which --help does without

        print_json({"error": text, "code": code})
    return status


def wants_json(arguments: Sequence[str]) -> bool:
    """Whether a command line has ``--json``; click may have failed before it parsed that."""
    return "--json" in takewhile(lambda argument: argument != "--", arguments)


if __name__ == "__main__":
    # By its name: in ``__main__`` its classes would exist twice.
    sys.exit(importlib.import_module("rmpa.cli.main").main())
