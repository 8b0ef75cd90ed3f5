"""Commands about this machine's agent: ``rmpa up``, ``reload``, ``config``, ``name``, ``doctor`` and ``why``.

``rmpa up``: the agent of this machine.
"""

from __future__ import annotations

import gc
import logging
import os
import socket
import sys
from collections import Counter
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from rmpa.cli.options import FiniteRange, agent_option, completes, config_option, json_option, setting_options
from rmpa.cli.output import LEVEL_COLOURS, Column, print_json, print_line, print_table, printable, read_name, warn
from rmpa.cli.peer import connect
from rmpa.config.module_name import (
    GATEWAY_SUFFIX,
    NameSource,
    choose_name,
    keep_name,
    state_dir,
)
from rmpa.config.read import load_settings
from rmpa.config.reference import json_value, schema_text, toml_value
from rmpa.config.settings import SETTINGS
from rmpa.core.counters import configure_logging
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.core.identity import peer_name_problem
from rmpa.observe import limits
from rmpa.observe.control import ReloadReply
from rmpa.observe.control_client import ControlClient, choose_agent, find_agents, running_agents
from rmpa.observe.peer_info import FAIL, OK, WARN, CheckLevel, exit_code
from rmpa.observe.why.diagnosis import Diagnosis
from rmpa.runtime.process import LogWriter
from rmpa.trust.permissions import TrustStatus

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rmpa.config.module_name import ModuleName
    from rmpa.config.read import Loaded
    from rmpa.config.schema import Setting
    from rmpa.config.settings import Settings
    from rmpa.observe.peer_info import Check


# ``rmpa reload``: let the agent read its settings again.


RELOAD_EPILOG = """\
\b
What takes effect at once: [bridge], [[contract]], [[peer]], [services], [[service]], [params], [[param]], [time]
and log.level. All else needs a restart, and is named. Variables and flags are those that the agent was started with.

\b
Examples:
  rmpa reload --check       would it be taken?
  rmpa reload               let it hold
  kill -HUP PID             the same, answered in the log
"""


@click.command("reload", epilog=RELOAD_EPILOG)
@click.option("--check", is_flag=True, help="Change nothing; only say what would come of it.")
@json_option
@agent_option
def reload(check: bool, as_json: bool, agent: str | None) -> int:
    """Make the agent read its rmpa.toml again; what the changes do not touch is not interrupted.

    Exit code 2 if the settings cannot be used; then nothing has changed.
    """
    with connect(agent) as client:
        reply = client.call("reload", ReloadReply, check=check)
    if as_json:
        print_json(reply)
    elif reply.problem:
        click.echo(f"rmpa: {printable(reply.problem)}", err=True)
    else:
        print_line(_reload_summary(reply, check=check))
        for note in reply.notes:
            warn(note)
        for key in reply.restart:
            warn(f"{key} {'needs' if check else 'waits for'} a restart")
    return 2 if reply.problem else 0


def _reload_summary(reply: ReloadReply, *, check: bool) -> str:
    where = reply.file or "no file"
    if not reply.changed:
        return f"{where}: nothing {'would change' if check else 'has changed'}"
    return f"{where}: {', '.join(reply.changed)} {'would take effect' if check else 'in effect'}"


# ``rmpa config``: the settings that hold and where each comes from; their JSON Schema for editors.


CONFIG_EPILOG = """\
\b
Examples:
  rmpa config show                        what `rmpa up` would take, and from where
  rmpa config show --config new.toml      is this file right?
  rmpa config schema > rmpa.schema.json   for editors: see docs/settings.md
"""


@click.group(epilog=CONFIG_EPILOG)
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


# The module that a command beside an agent is about: its name, settings and files, and its agent if that runs.


_module_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class FoundName:
    """The name of a module of this machine.

    Attributes:
        chosen: Its name, and why it was chosen.
        loaded: The settings, with that name.
        socket: The control socket of its agent; ``None``: none runs.
    """

    chosen: ModuleName
    loaded: Loaded
    socket: Path | None


@dataclass(frozen=True, slots=True)
class Module:
    """One module of this machine.

    Attributes:
        chosen: Its name, and why it was chosen.
        loaded: The settings, with that name.
        state: Its state directory; ``None``: there is none.
        socket: The control socket of its agent; ``None``: none runs.
        trust: What its agent says of trust; ``None``: none runs.
        config_file: The settings of its agent; empty: it has none, or none runs.
    """

    chosen: ModuleName
    loaded: Loaded
    state: Path | None
    socket: Path | None = None
    trust: TrustStatus | None = None
    config_file: str = ""

    @property
    def name(self) -> str:
        """Its name."""
        return self.chosen.name

    @property
    def secured(self) -> bool:
        """Whether its agent runs as a member of a secured mesh."""
        return self.trust is not None and self.trust.agent == "secured"


def find_name(
    name: str | None, options: Mapping[str, object], environ: Mapping[str, str], option: str = "--name"
) -> FoundName:
    """The name of the module that a command beside an agent is about.

    Args:
        name: As the command's option names it.
        options: As for ``load_settings``.
        environ: The environment's variables.
        option: The command's option, for errors.

    Raises:
        ConfigError: The name cannot be one, or a setting cannot be used.
        RmpaError: Several agents run, and none is meant.
    """
    for source, text in ((option, name), ("RMPA_AGENT", environ.get("RMPA_AGENT"))):
        if text and (problem := peer_name_problem(text)):
            raise ConfigError(source, problem)
    loaded = load_settings(options, environ, host_name=socket.gethostname())
    agents = find_agents(environ)
    names = {**loaded.names, NameSource.AGENT_VARIABLE: environ.get("RMPA_AGENT", "")}
    if name:
        names[NameSource.OPTION] = name
    chosen = choose_name(names, *running_agents(agents, environ))
    loaded = replace(loaded, settings=replace(loaded.settings, name=chosen.name))
    return FoundName(chosen, loaded, next((agent.path for agent in agents if agent.name == chosen.name), None))


def find_module(
    name: str | None, options: Mapping[str, object], environ: Mapping[str, str], option: str = "--name"
) -> Module:
    """The module that a command beside an agent is about, as its agent knows it if that runs.

    Args and errors as for ``find_name``; also ``RmpaError``: the agent does not answer.
    """
    found = find_name(name, options, environ, option)
    chosen, loaded, path = found.chosen, found.loaded, found.socket
    if path is None:
        return Module(chosen, loaded, state_dir(environ, loaded.settings.state_dir))
    with ControlClient(path) as client:
        trust, config_file = client.call("trust", TrustStatus, what="status"), client.agent().config_file
    # The agent may have been started with another state directory than this shell has.
    state = Path(trust.folder).parent.parent if trust.folder else None
    return Module(chosen, loaded, state, path, trust, config_file)


def keep_first_name(settings: Settings, names: Mapping[NameSource, str]) -> None:
    """Keep a name that was given by ``--name`` at the first start of a module, for the starts and commands to come.

    One that starts beside another agent is a second module of this machine, and a gateway is none.
    """
    directory = state_dir(os.environ, settings.state_dir)
    name = names[NameSource.OPTION]
    if not name or directory is None or names[NameSource.KEPT] or name.endswith(GATEWAY_SUFFIX):
        return
    try:
        if any(agent.name != name for agent in find_agents(os.environ)):
            return
        keep_name(directory, name)
    except RmpaError as error:
        _module_log.warning("! the name %s is not kept: %s", name, error)


# ``rmpa doctor``: checks this machine for what would keep modules apart.


DOCTOR_EPILOG = """\
\b
Exit codes: 0 nothing fails (there may be warnings); 1 something does.

\b
Examples:
  rmpa doctor
  sudo rmpa doctor                reads the firewall's rules too
  rmpa doctor --listen 30         and `rmpa doctor` on another machine: do multicasts get through?
  rmpa doctor --json | jq '.[] | select(.level == "fail")'
"""


@click.command(epilog=DOCTOR_EPILOG)
@click.option("--config", metavar="FILE", help="Settings. [default: ./rmpa.toml, ~/.config/rmpa, /etc/rmpa]")
@click.option("-q", "--quiet", is_flag=True, help="Only what fails, or may.")
@click.option("--listen", metavar="SECONDS", type=FiniteRange(1.0), help="Wait for multicasts of other machines.")
@json_option
def doctor(config: str | None, quiet: bool, listen: float | None, as_json: bool) -> int:
    """Check this machine: settings, agents, network, ROS environment, clock and rights.

    It changes nothing. It sends one packet on each interface to the agents' multicast group, which agents ignore, and
    checks that it comes back. To see whether a switch or a firewall in between drops it, run it with --listen on one
    machine and meanwhile without on the other, then the other way round.
    """
    from rmpa.observe.doctor.checks import examine
    from rmpa.observe.doctor.machine import look_at

    found, shown = [], []
    for check in examine(look_at(os.environ, config, listen or 0.0)):
        found.append(check)
        if not quiet or check.level in (WARN, FAIL):
            shown.append(check)
            if not as_json:
                click.echo("\n".join(_lines(check)))
    if as_json:
        print_json([*map(_json, shown)])
    else:
        click.echo(_summary(found))
    return exit_code(found)


def _json(check: Check) -> dict[str, str]:
    keys = {"check": check.name, "subject": check.where, "level": check.level, "text": check.text}
    return keys | ({"remedy": check.remedy} if check.remedy else {})


def _lines(check: Check) -> list[str]:
    mark = click.style(f"{check.level.value:<7}", fg=LEVEL_COLOURS[check.level])
    what = f"{check.name} {check.where}".strip()
    lines = [f"{mark}  {printable(what)}: {printable(check.text)}"]
    if check.remedy:
        lines.append(f"{'':<9}{printable(check.remedy)}")
    return lines


def _summary(found: Sequence[Check]) -> str:
    counts = Counter(check.level for check in found)
    words = [f"{counts[level]} {level.value}" for level in CheckLevel if counts[level]]
    return f"{len(found)} answers: {', '.join(words)}"


# ``rmpa why``: the stage at which a topic of a peer, or a service, stops.


WHY_EPILOG = """\
\b
Exit codes: 0 it flows, on every way if there are several, or no node subscribes and nothing is in its way;
1 it does not flow, and the first stage that fails says why.

\b
Examples:
  rmpa why joystick:/cmd          why /cmd of joystick does not come here
  rmpa why /odom                  every way of /odom, in and out
  rmpa why arm:/move              why the service /move of arm cannot be called here
  rmpa why --module arm           why the module arm is not linked, or slow
  rmpa why joystick:/cmd --json | jq '.[].stages[-1]'
"""

_WELL: Final = {"service": "it can be called", "module": "it is linked"}
"""What is said of a thing by its kind when no stage fails."""


@click.command(epilog=WHY_EPILOG)
@click.argument("name", metavar="[PEER:]NAME", shell_complete=completes("topic"))
@click.option("-s", "--service", is_flag=True, help="A service is meant, though a topic has that name.")
@click.option("-m", "--module", is_flag=True, help="NAME is a module: its link is checked.")
@json_option
@agent_option
def why(name: str, service: bool, module: bool, as_json: bool, agent: str | None) -> int:
    """Say why a topic of a peer does not arrive here, a service cannot be called, or a module is not linked.

    Both agents are asked, stage by stage from the publisher to the reader; messages are watched for a second, and
    a service's server is probed.
    PEER is a name or a GUID. Without PEER every module that publishes the topic is checked, and for one of this
    module's own topics every peer says how it arrives there.
    """
    if module:
        args: dict[str, object] = {"module": name}
    else:
        wanted = read_name(name)
        args = {"name": wanted.name, "peer": wanted.peer, "service": service}
    with ControlClient(choose_agent(os.environ, agent).path, timeout=limits.CONTROL_HANDLER_TIMEOUT) as client:
        if not module and any(peer.name == name for peer in client.snapshot(topics=()).peers):
            raise ConfigError("NAME", f"{name} is a module", f"`rmpa why --module {name}` says how it is linked")
        found = client.call("why", tuple[Diagnosis, ...], **args)
    if as_json:
        print_json(found)
    else:
        for number, diagnosis in enumerate(found):
            if number:
                click.echo()
            for line in _stage_lines(diagnosis):
                click.echo(line)
    return why_exit_code(found)


def why_exit_code(diagnoses: Sequence[Diagnosis]) -> int:
    """0 if messages or calls get through on every path that was asked about, else 1."""
    return 0 if diagnoses and all(diagnosis.flows for diagnosis in diagnoses) else 1


def _stage_lines(diagnosis: Diagnosis) -> list[str]:
    of = f" of {diagnosis.node}" if diagnosis.node else ""
    way = f" from {diagnosis.peer}" if diagnosis.peer and diagnosis.kind != "module" else ""
    to = f" to {diagnosis.to}" if diagnosis.to else ""
    lines = [printable(f"{diagnosis.name}{of}{way}{to}:")]
    width = max((len(stage.name) for stage in diagnosis.stages), default=0)
    lines += [_line(stage, width) for stage in diagnosis.stages]
    failed = diagnosis.failed
    if diagnosis.unasked:
        lines.append(_paint("nothing is in its way: it flows as soon as a node subscribes", WARN))
    elif failed is None:
        lines.append(_paint(_WELL.get(diagnosis.kind, "it flows"), OK))
    else:
        lines.append(_paint(printable(f"it stops at: {failed.name}"), FAIL))
        if failed.remedy:
            lines.append(printable(f"what to do: {failed.remedy}"))
    return lines


def _line(stage: Check, width: int) -> str:
    mark = _paint(f"{stage.level.value:<7}", stage.level)
    advice = f" ({stage.remedy})" if stage.remedy and stage.level is WARN else ""
    return f"  {mark}  {printable(stage.name):<{width}}  {printable(stage.text + advice)}"


def _paint(text: str, level: CheckLevel) -> str:
    return click.style(text, fg=LEVEL_COLOURS[level])


_up_log = logging.getLogger("rmpa.up")
UP_EPILOG = """\
\b
Settings, each stronger than the last: the ROS environment (ROS_MASTER_URI's port, ROS_DOMAIN_ID,
ROS_STATIC_PEERS, ROS_AUTOMATIC_DISCOVERY_RANGE), rmpa.toml, RMPA_* variables, options.
`rmpa config show` prints those that hold, each with its source.
The name that the first --name gave is kept in the state directory (the file module-name), and holds where no other
one is given.

\b
Examples:
  rmpa up                                 all defaults; the name is that of the first start, else the host's
  rmpa up --name base --interface wlan0   on one interface only
  rmpa up --seed 10.8.0.5:40001           greet an agent that multicast does not reach
  rmpa up --name b2 --core-port 11312     a second agent on this machine
  rmpa up --keep never                    forget what the core kept of the run before
  rmpa up --prefix-peers                  beside robots of the same kind: their names stay apart
  rmpa up --core external                 join the graph of a roscore that runs already
  rmpa up --realtime                      punctual on a busy machine; the log says what was not granted
"""


@click.command(epilog=UP_EPILOG)
@setting_options("up")
@config_option
def up(**options: object) -> int:
    """Run this machine's agent: ROS core, discovery, mesh and bridge."""
    load = partial(load_settings, options, dict(os.environ), host_name=socket.gethostname())
    loaded = load()
    writer = LogWriter(sys.stderr.fileno())
    configure_logging(loaded.settings.log_level, writer, as_json=loaded.settings.log_json)
    for note in loaded.notes:
        _up_log.warning("%s", note)
    chosen = choose_name(loaded.names)
    if chosen.source is NameSource.KEPT:
        _up_log.info("= the module is %s, as at its first start (%s)", chosen.name, loaded.given["name"])
    # Imports leave no garbage: without collection the start takes a third less time. The agent turns it on again.
    gc.disable()
    from rmpa.agent.agent import run

    try:
        return run(loaded.settings, load, partial(keep_first_name, loaded.settings, loaded.names))
    finally:
        writer.close()
