"""``rmpa reload``: let the agent read its settings again."""

from __future__ import annotations

import click

from rmpa.cli.options import agent_option, json_option
from rmpa.cli.output import print_json, print_line, printable, warn
from rmpa.cli.peer import connect
from rmpa.observe.control import ReloadReply

EPILOG = """\
\b
What takes effect at once: [bridge], [[contract]], [[peer]], [services], [[service]], [params], [[param]], [time]
and log.level. All else needs a restart, and is named. Variables and flags are those that the agent was started with.

\b
Examples:
  rmpa reload --check       would it be taken?
  rmpa reload               let it hold
  kill -HUP PID             the same, answered in the log
"""


@click.command("reload", epilog=EPILOG)
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
        print_line(_summary(reply, check=check))
        for note in reply.notes:
            warn(note)
        for key in reply.restart:
            warn(f"{key} {'needs' if check else 'waits for'} a restart")
    return 2 if reply.problem else 0


def _summary(reply: ReloadReply, *, check: bool) -> str:
    where = reply.file or "no file"
    if not reply.changed:
        return f"{where}: nothing {'would change' if check else 'has changed'}"
    return f"{where}: {', '.join(reply.changed)} {'would take effect' if check else 'in effect'}"
