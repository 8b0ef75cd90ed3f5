"""``rmpa why``: the stage at which a topic of a peer, or a service, stops."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Final

import click

from rmpa.cli.graph import read_name
from rmpa.cli.options import agent_option, completes, json_option
from rmpa.cli.output import LEVEL_COLOURS, print_json, printable
from rmpa.core.errors import ConfigError
from rmpa.observe import limits
from rmpa.observe.control_client import ControlClient, choose_agent
from rmpa.observe.peer_info import FAIL, OK, WARN
from rmpa.observe.why.diagnosis import Diagnosis

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.observe.peer_info import Check, CheckLevel

EPILOG = """\
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


@click.command(epilog=EPILOG)
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
            for line in _lines(diagnosis):
                click.echo(line)
    return exit_code(found)


def exit_code(diagnoses: Sequence[Diagnosis]) -> int:
    """0 if messages or calls get through on every path that was asked about, else 1."""
    return 0 if diagnoses and all(diagnosis.flows for diagnosis in diagnoses) else 1


def _lines(diagnosis: Diagnosis) -> list[str]:
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
