"""``rmpa doctor``: checks this machine for what would keep modules apart."""

from __future__ import annotations

import os
from collections import Counter
from typing import TYPE_CHECKING

import click

from rmpa.cli.options import FiniteRange, json_option
from rmpa.cli.output import LEVEL_COLOURS, print_json, printable
from rmpa.observe.peer_info import FAIL, WARN, CheckLevel, exit_code

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.observe.peer_info import Check

EPILOG = """\
\b
Exit codes: 0 nothing fails (there may be warnings); 1 something does.

\b
Examples:
  rmpa doctor
  sudo rmpa doctor                reads the firewall's rules too
  rmpa doctor --listen 30         and `rmpa doctor` on another machine: do multicasts get through?
  rmpa doctor --json | jq '.[] | select(.level == "fail")'
"""


@click.command(epilog=EPILOG)
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
    from rmpa.observe.doctor.checks import examine, look_at

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
