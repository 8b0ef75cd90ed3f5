"""Verbs about this machine's agent: ``rmpa up`` with its advice, ``reload``, ``config``, ``why`` and ``explain``."""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import shutil
import socket
import sys
import threading
import time
from functools import partial
from textwrap import shorten
from typing import TYPE_CHECKING, Final

import click

from rmpa.cli.graph import read_name, suggestion
from rmpa.cli.main import verb
from rmpa.cli.options import Options, agent_verb, argument, config_option, flag, json_verb, setting_options, topics
from rmpa.cli.output import Painted, Table, begin_log, paint_level, print_error, printable, warn
from rmpa.config.module_name import GATEWAY_SUFFIX, NameSource, choose_name, keep_name, state_dir
from rmpa.config.read import load_settings
from rmpa.config.settings import SETTINGS, Settings, json_value, schema_text, toml_value
from rmpa.core import codes
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.observe import limits
from rmpa.observe.check import FAIL, OK, WARN
from rmpa.observe.control_client import ControlClient, ReloadReply, find_agents, runtime_dir, same_core
from rmpa.observe.why.diagnosis import Diagnosis
from rmpa.ros.environment import DEFAULT_MASTER_URI, shown_uri
from rmpa.runtime.systemd import LogWriter

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from rmpa.config.schema import Setting
    from rmpa.observe.snapshot import Snapshot

_log = logging.getLogger("rmpa.up")
# What is said of a thing by its kind when no stage fails.
_WELL: Final = {"service": "it can be called", "module": "it is linked"}
# Seconds in which a first peer is linked, if there is one: it takes some 0.3 s.
_FIRST_PEER: Final = 2.0
# Seconds between two looks.
_LOOK: Final = 0.2
_COLUMNS: Final = 80
_HEADS: Final = ("Next:", "     ", "     ")


@agent_verb(flag("--check", "Change nothing; only say what would change."))
def reload(check: bool, options: Options) -> int:
    """Make the agent read its rmpa.toml again; what has not changed is not interrupted.

    Exit code 2 if the settings cannot be used, or it would not start with them; then nothing has changed.

    ---
    What takes effect at once: [bridge], [[contract]], [[peer]], [services], [[service]], [params], [[param]], [time]
    and log.level. Everything else needs a restart, and is listed. Variables and options stay those of the agent's
    start.

    Examples:
      rmpa reload --check       is the file valid, and what would change?
      rmpa reload               apply it
      kill -HUP PID             the same; the answer is in the log
    """
    with options.client() as client:
        reply = client.call("reload", ReloadReply, check=check)

    def text() -> Iterator[str]:
        if reply.problem:
            print_error(reply.problem, reply.code or "invalid-value")
            return
        what = f"nothing {'would change' if check else 'has changed'}"
        if reply.changed:
            what = f"{', '.join(reply.changed)} {'would take effect' if check else 'in effect'}"
        yield f"{reply.file or 'no file'}: {what}"
        for note in reply.notes:
            warn(note, "doubtful-setting")
        for key in reply.restart:
            warn(f"{key} {'would take' if check else 'takes'} effect after a restart", "needs-restart")

    options.show(reply, text())
    return 2 if reply.problem else 0


@json_verb(config_option)
def config_show(config: str | None, options: Options) -> None:
    """Print each setting that `rmpa up` would use here, and where it comes from.

    A running agent may have others: options of its command line, or a file that was changed later (see rmpa reload).
    """
    loaded = load_settings({"config": config}, dict(os.environ), host_name=socket.gethostname())
    rows = []
    for setting in SETTINGS:
        given = loaded.given.get(setting.name)
        origin = str(given) if given else "the host's name" if setting.name == "name" else "default"
        rows.append((setting, setting.value_in(loaded.settings), origin))
    settings = [{"name": s.title, "value": json_value(value), "from": origin} for s, value, origin in rows]
    table = Table("SETTING, VALUE, FROM", [(s.title, _shown(s, value), origin) for s, value, origin in rows])
    file = str(loaded.settings.config_file or "")
    options.show({"file": file, "settings": settings, "notes": loaded.notes}, table)
    for note in () if options.as_json else loaded.notes:
        warn(note, "doubtful-setting")


def _shown(setting: Setting, value: object) -> str:
    if setting.is_list_of_tables and isinstance(value, tuple):
        return f"{len(value)} table{'' if len(value) == 1 else 's'}" if value else "none"
    return toml_value(value)


@verb()
def config_schema() -> None:
    """Print the JSON Schema of rmpa.toml: editors check and complete the file with it."""
    click.echo(schema_text(), nl=False)


@json_verb(click.argument("code", required=False))
def explain(code: str | None, options: Options) -> None:
    """Say what a code such as [port-in-use], at the end of an error or a warning, means, and what to do.

    Without CODE all codes are listed, one a line.

    ---

    Examples:
      rmpa explain port-in-use
    """
    wanted, known = (code or "").strip("[]"), codes.texts()
    if wanted and wanted not in known:
        remedy = suggestion(wanted, known, "`rmpa explain` shows all")
        raise ConfigError("CODE", f"there is no code {wanted!r}", remedy, code="unknown-name")
    found = [(one, *map(codes.plain, about)) for one, about in known.items() if wanted in ("", one)]
    fields = ("code", "meaning", "remedy")
    rows = [dict(zip(fields, each, strict=True)) for each in found]
    if wanted:
        texts = (
            (one, *(click.wrap_text(text, 78, "  ", "  ").splitlines() for text in about)) for one, *about in found
        )
        options.show(rows, texts)
    else:
        first = max(map(len, known)) + 2
        width = shutil.get_terminal_size().columns if sys.stdout.isatty() else sys.maxsize
        options.show(rows, (f"{one:<{first}}{shorten(about, width - first)}" for one, about, _ in found))


@agent_verb(
    argument("name", topics, metavar="[PEER:]NAME"),
    flag("-s --service", "NAME is a service, although a topic has that name."),
    flag("-m --module", "NAME is a module: its link is checked."),
)
def why(name: str, service: bool, module: bool, options: Options) -> int:
    """Say why a topic of a peer does not arrive here, a service cannot be called, or a module is not linked.

    Both agents are asked, stage by stage from the publisher to the subscriber. Messages are counted for a second; the
    server of a service is probed. PEER is a name or a GUID. Without PEER every module that publishes the topic is
    checked; for a topic of this module every peer is asked how it arrives there.

    ---
    Exit codes: 0 it flows, on every path if there are several, or it would flow if a node subscribed;
    1 it does not flow, and the first stage that fails says why.

    Examples:
      rmpa why joystick:/cmd          why /cmd of joystick does not arrive here
      rmpa why /odom                  every path of /odom, in and out
      rmpa why arm:/move              why the service /move of arm cannot be called here
      rmpa why --module arm           why the module arm is not linked, or slow
      rmpa why joystick:/cmd --json | jq '.[].stages[-1]'
    """
    if module:
        args: dict[str, object] = {"module": name}
    else:
        wanted = read_name(name)
        args = {"name": wanted.name, "peer": wanted.peer, "service": service}
    with options.client(limits.CONTROL_HANDLER_TIMEOUT) as client:
        if not module and any(peer.name == name for peer in client.snapshot(topics=()).peers):
            raise ConfigError("NAME", f"{name} is a module", f"`rmpa why --module {name}` says how it is linked")
        found = client.call("why", tuple[Diagnosis, ...], **args)
    options.show(found, ((([""] if number else []), stage_lines(one)) for number, one in enumerate(found)))
    return 0 if found and all(diagnosis.flows for diagnosis in found) else 1


def stage_lines(diagnosis: Diagnosis) -> Iterator[str]:
    """The stages of one path, and what follows from them."""
    of = f" of {diagnosis.node}" if diagnosis.node else ""
    way = f" from {diagnosis.peer}" if diagnosis.peer and diagnosis.kind != "module" else ""
    to = f" to {diagnosis.to}" if diagnosis.to else ""
    yield f"{diagnosis.name}{of}{way}{to}:"
    width = max((len(stage.name) for stage in diagnosis.stages), default=0)
    for stage in diagnosis.stages:
        mark = paint_level(f"{stage.level.value:<7}", stage.level)
        advice = f" ({stage.remedy})" if stage.remedy and stage.level is WARN else ""
        code = f" [{stage.code}]" if stage.code else ""
        yield Painted(f"  {mark}  {printable(stage.name):<{width}}  {printable(stage.text + advice + code)}")
    failed = diagnosis.failed
    if diagnosis.unasked:
        yield paint_level("nothing prevents it: it flows as soon as a node subscribes", WARN)
    elif failed is None:
        yield paint_level(_WELL.get(diagnosis.kind, "it flows"), OK)
    else:
        yield paint_level(f"it stops at: {failed.name}", FAIL)
        if failed.remedy:
            yield f"what to do: {failed.remedy}"


@verb(
    setting_options("up"),
    config_option,
    flag("-q --quiet", "Only warnings (--log-level warning), and no advice about what to do next."),
)
def up(quiet: bool, **options: object) -> int:
    """Run this machine's agent: ROS core, discovery, mesh and bridge.

    ---
    Where settings come from, a later one overrides an earlier one: the ROS environment (ROS_MASTER_URI's port,
    ROS_DOMAIN_ID, ROS_STATIC_PEERS, ROS_AUTOMATIC_DISCOVERY_RANGE), rmpa.toml, RMPA_* variables, options.
    `rmpa config show` prints the values in effect, and where each comes from.
    The name of the first --name is kept in the state directory (file module-name), and is used where no other name is
    given.

    Examples:
      rmpa up                                 all defaults; the name is that of the first start, else the host's
      rmpa up --name base --interface wlan0   on one interface only
      rmpa up --seed 10.8.0.5:40001           also find an agent that multicast does not reach
      rmpa up --name b2 --core-port 11312     a second agent on this machine
      rmpa up --keep never                    do not restore what the core kept of the last run
      rmpa up --prefix-peers                  with robots of the same kind: each gets a prefix
      rmpa up --core external                 join the graph of a roscore that runs already
      rmpa up --realtime                      real-time priority; the log says what was not granted
    """
    if quiet and options["log_level"] is None:
        options["log_level"] = "warning"
    load = partial(load_settings, options, dict(os.environ), host_name=socket.gethostname())
    loaded = load()
    writer = LogWriter(sys.stderr.fileno())
    journal = begin_log(loaded.settings, loaded.notes, _log, writer)
    chosen = choose_name(loaded.names)
    if chosen.source is NameSource.KEPT:
        _log.info("= the module is %s, as at its first start (%s)", chosen.name, loaded.given["name"])
    # Imports leave no garbage: without collection the start takes a third less time. The agent turns it on again.
    gc.disable()
    from rmpa.agent.agent import run

    advised = sys.stderr.isatty() and advises(loaded.settings, os.environ, quiet=quiet or journal)

    def started() -> None:
        _keep_first_name(loaded.settings, loaded.names)
        if advised:
            threading.Thread(target=advise, args=(loaded.settings,), name="advice", daemon=True).start()

    try:
        return run(loaded.settings, load, started)
    finally:
        writer.close()


def _keep_first_name(settings: Settings, names: Mapping[NameSource, str]) -> None:
    """Keep a name that was given by ``--name`` at the first start of a module, for the starts and commands to come.

    One that starts beside another agent is a second module of this machine, and a gateway is none.
    """
    directory = state_dir(os.environ, settings.state_dir)
    name = names[NameSource.OPTION]
    if not name or directory is None or names[NameSource.KEPT] or name.endswith(GATEWAY_SUFFIX):
        return
    try:
        if all(agent.name == name for agent in find_agents(os.environ)):
            keep_name(directory, name)
    except RmpaError as error:
        _log.warning("! the name %s is not kept: %s [directory-unusable]", name, error)


def advises(settings: Settings, environ: Mapping[str, str], *, quiet: bool) -> bool:
    """Whether the terminal of an agent gets advice: not if a service manager or a program reads what it says."""
    return not (quiet or settings.log_json or "NOTIFY_SOCKET" in environ)


def advise(settings: Settings) -> None:
    """Print the next steps on standard error, as soon as a peer is linked or has had the time for it."""
    place = runtime_dir(os.environ, settings.runtime_dir) / f"{settings.name}.sock"
    until = time.monotonic() + _FIRST_PEER
    with contextlib.suppress(RmpaError, OSError), ControlClient(place) as client:
        shown = client.snapshot(topics=(), services=())
        while not any(peer.link for peer in shown.peers) and time.monotonic() < until:
            time.sleep(_LOOK)
            shown = client.snapshot(topics=(), services=())
        lines = next_steps(settings, shown, os.environ.get("ROS_MASTER_URI", ""))
        text = [printable(f"{head} {line}") for head, line in zip(_HEADS, lines, strict=True)]
        click.echo("\n".join(text), err=True)


def next_steps(settings: Settings, shown: Snapshot, master: str) -> list[str]:
    """What to do after the start of an agent, in three lines.

    Args:
        settings: Its settings.
        shown: What it knows.
        master: The ROS_MASTER_URI of its shell; empty: not set.
    """
    core = shown_uri(shown.agent.core_uri)
    nodes = "nodes of this machine join as soon as they start"
    if not same_core(core, master or DEFAULT_MASTER_URI):
        wrong = "ROS_MASTER_URI is wrong" if master else "each shell of nodes needs"
        nodes = _fitting(f"{wrong}: export ROS_MASTER_URI={core}", f"export ROS_MASTER_URI={core}")
        if same_core(core, DEFAULT_MASTER_URI):
            # Not unset: nodes of roscpp end without it.
            nodes = _fitting(f"wrong: export ROS_MASTER_URI={core}, also in ~/.bashrc", nodes)
    page = f"http://localhost:{settings.web.port}/" if settings.web.enabled else "rmpa web"
    return [_about_peers(settings, shown), f"to look: rmpa peer list; in a browser: {page}", nodes]


def _fitting(*lines: str) -> str:
    """The first of several ways to say something that fits a terminal, else the last: no command is cut."""
    most = _COLUMNS - len(_HEADS[0]) - 1
    return next((line for line in lines if len(line) <= most), lines[-1])


def _about_peers(settings: Settings, shown: Snapshot) -> str:
    linked = [peer.name for peer in shown.peers if peer.link]
    if linked:
        others = f" and {len(linked) - 1} more" if len(linked) > 1 else ""
        hint = "if a topic does not arrive: rmpa why NAME"
        return _fitting(f"linked with {linked[0]}{others}; {hint}", f"linked with {len(linked)}; {hint}")
    if shown.peers:
        hint = f"rmpa why --module {shown.peers[0].name}"
        return _fitting(f"{shown.peers[0].name} was found but is not linked: {hint}", f"no link: {hint}", hint)
    if shown.strangers:
        one = shown.strangers[0]
        hint = f"{'pending' if one.invite else 'not of this mesh'}: rmpa peer list says what to do"
        return _fitting(f"{one.name} is {hint}", f"a module is {hint}")
    if "lo" in settings.interfaces:
        return f"no peer yet; a second module here: rmpa up --name OTHER --core-port {settings.core_port + 1}"
    if shown.agent.addresses in ((), ("127.0.0.1",)):
        return "no network: connect this machine to one, or see rmpa doctor"
    domain = f" --domain {settings.domain}" if settings.domain else ""
    if shown.trust is not None:
        return "no peer yet: rmpa trust invite here, rmpa trust join and rmpa up there"
    if not settings.multicast.enabled:
        there = f"rmpa up --name OTHER{domain} --seed {shown.agent.guid.partition('#')[0]}"
        return _fitting(f"no peer yet; there: {there}", f"there: {there}")
    return f"no peer yet; on the other machine: rmpa up --name OTHER{domain}"
