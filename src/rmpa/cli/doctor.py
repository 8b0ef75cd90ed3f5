"""``rmpa doctor``: checks this machine for what would keep modules apart."""

from __future__ import annotations

import os
from collections import Counter
from typing import TYPE_CHECKING, Final

import click

from rmpa.cli.options import json_option
from rmpa.cli.output import print_json, printable
from rmpa.observe.doctor.finding import FindingLevel, exit_code

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.observe.doctor.finding import Finding

_COLOURS: Final = {
    FindingLevel.OK: "green",
    FindingLevel.WARN: "yellow",
    FindingLevel.FAIL: "red",
    FindingLevel.SKIPPED: "cyan",
}
EPILOG = """\
\b
Exit codes: 0 nothing fails (there may be warnings); 1 something does.

\b
Examples:
  rmpa doctor
  sudo rmpa doctor                reads the firewall's rules too
  rmpa doctor --json | jq '.[] | select(.level == "fail")'
"""


@click.command(epilog=EPILOG)
@click.option("--config", metavar="FILE", help="Settings. [default: ./rmpa.toml, ~/.config/rmpa, /etc/rmpa]")
@click.option("-q", "--quiet", is_flag=True, help="Only what fails, or may.")
@json_option
def doctor(config: str | None, quiet: bool, as_json: bool) -> int:
    """Check this machine: settings, agents, network, ROS environment, clock and rights.

    It changes nothing. It sends one packet on each interface to the agents' multicast group, which agents ignore, and
    checks that it comes back. It cannot see a firewall on another machine or a switch in between: run it on both
    machines, and `rmpa multicast` between them.
    """
    from rmpa.observe.doctor.io.checks import examine, look_at

    found, shown = [], []
    for finding in examine(look_at(os.environ, config)):
        found.append(finding)
        if not quiet or finding.level in (FindingLevel.WARN, FindingLevel.FAIL):
            shown.append(finding)
            if not as_json:
                click.echo("\n".join(_lines(finding)))
    if as_json:
        print_json(shown)
    else:
        click.echo(_summary(found))
    return exit_code(found)


def _lines(finding: Finding) -> list[str]:
    mark = click.style(f"{finding.level.value:<7}", fg=_COLOURS[finding.level])
    what = f"{finding.check} {finding.subject}".strip()
    lines = [f"{mark}  {printable(what)}: {printable(finding.text)}"]
    if finding.remedy:
        lines.append(f"{'':<9}{printable(finding.remedy)}")
    return lines


def _summary(found: Sequence[Finding]) -> str:
    counts = Counter(finding.level for finding in found)
    words = [f"{counts[level]} {level.value}" for level in FindingLevel if counts[level]]
    return f"{len(found)} answers: {', '.join(words)}"
