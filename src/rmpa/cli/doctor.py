"""``rmpa doctor``: checks this machine; with ``--fix`` it shows what it would do, asks, does it, and checks again."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections import Counter
from typing import TYPE_CHECKING

from rmpa.cli.options import FiniteRange, Options, config_option, flag, json_verb, option
from rmpa.cli.output import Painted, confirm, paint_level, print_text, printable, warn
from rmpa.observe import limits
from rmpa.observe.check import FAIL, WARN, Check, CheckLevel, exit_code
from rmpa.observe.doctor.checks import examine
from rmpa.observe.doctor.machine import DoctorInput, look_at
from rmpa.observe.doctor.repairs import Repair, find_repairs

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence


@json_verb(
    config_option,
    flag("-q --quiet", "Show only failures and warnings."),
    option("--listen", "SECONDS", "Wait for multicasts of other machines.", type=FiniteRange(1.0)),
    flag("--fix", "Repair what is safe: show the commands, ask, run them, check again."),
    flag("--yes", "With --fix: do not ask."),
)
def doctor(config: str | None, quiet: bool, listen: float | None, fix: bool, yes: bool, options: Options) -> int:
    """Check this machine: settings, agents, network, ROS environment, clock and rights.

    Without --fix it changes nothing. It sends one packet on each interface to the agents' multicast group, which
    agents ignore, and checks that it comes back. To see whether a switch or a firewall in between drops it, run it
    with --listen on one machine and meanwhile without on the other, then the other way round.

    ---
    Safe repairs stop nothing: start or enable rmpa's unit, join the group of its socket, give a directory back to
    this user, remove the files of a killed agent. Without a terminal --fix shows the commands, and exits with 1.
    Firewalls, clocks, kernel settings and nodes are never touched: the commands for those are printed.

    Exit codes: 0 nothing fails (there may be warnings); 1 something does.

    Examples:
      rmpa doctor
      rmpa doctor --fix               shows what it would do, and asks
      sudo rmpa doctor                reads the firewall's rules too
      rmpa doctor --listen 30         and `rmpa doctor` on another machine: do multicasts get through?
      rmpa doctor --json | jq '.[] | select(.level == "fail")'
    """
    if fix:
        return put_right(lambda: look_at(os.environ, config), options, yes=yes)
    found, shown = [], []
    for check in examine(look_at(os.environ, config, listen or 0.0)):
        found.append(check)
        if not quiet or check.level in (WARN, FAIL):
            shown.append(check)
            if not options.as_json:
                print_text(check_lines(check))
    options.show([*map(check_json, shown)], checks_summary(found))
    return exit_code(found)


def check_json(check: Check) -> dict[str, str]:
    """A result of ``rmpa doctor`` for programs."""
    keys = {"check": check.name, "subject": check.where, "level": check.level, "text": check.text}
    return keys | {key: text for key, text in (("remedy", check.remedy), ("code", check.code)) if text}


def check_lines(check: Check) -> Iterator[str]:
    """A result of ``rmpa doctor`` for people."""
    what = printable(f"{check.name} {check.where}".strip())
    yield Painted(f"{paint_level(f'{check.level.value:<7}', check.level)}  {what}: {printable(check.line)}")
    if check.remedy:
        yield f"{'':<9}{check.remedy}"


def checks_summary(found: Sequence[Check]) -> str:
    """How many results there are of each level."""
    counts = Counter(check.level for check in found)
    words = [f"{counts[level]} {level.value}" for level in CheckLevel if counts[level]]
    return f"{len(found)} answers: {', '.join(words)}"


def put_right(look: Callable[[], DoctorInput], options: Options, *, yes: bool) -> int:
    """Repair what can be; return the exit code.

    Args:
        look: Reads the machine anew.
        options: Of the command line.
        yes: Whether nothing is asked.
    """
    given = look()
    before, plan = list(examine(given)), find_repairs(given)
    planned = {(repair.check, repair.where) for repair in plan}
    by_hand = [one for one in before if one.level in (WARN, FAIL) and (one.name, one.where) not in planned]
    if not options.as_json:
        print_text(_plan_lines(plan, by_hand))
    wanted = plan if _agreed(plan, options, yes=yes) else []
    done = [repair for repair in find_repairs(look()) if repair in wanted] if wanted else []  # they may have gone
    failed = [repair for repair in done if not _run(repair)]
    after = list(examine(look())) if wanted else before
    rest = [check for check in after if check.level in (WARN, FAIL)]
    value = {
        "plan": [{"check": r.check, "text": r.text, "command": str(r), "undo": r.undo} for r in plan],
        "by_hand": [*map(check_json, by_hand)],
        "done": [str(repair) for repair in done if repair not in failed],
        "failed": [str(repair) for repair in failed],
        "checks": [*map(check_json, after)],
    }
    again = ["", "Checked again:", *(line for check in rest for line in check_lines(check))] if wanted else []
    options.show(value, [*again, checks_summary(after)])
    return 1 if failed or (plan and not wanted) else exit_code(after)


def _plan_lines(plan: Sequence[Repair], by_hand: Sequence[Check]) -> Iterator[str]:
    yield "What can be repaired:" if plan else "Nothing here can be repaired by a safe command."
    for repair in plan:
        yield f"  {repair.check} {repair.where}".rstrip() + f": {repair.text}"
        yield f"    do:   {repair}"
        yield f"    undo: {repair.undo}"
    if advised := [check for check in by_hand if check.remedy]:
        yield "By hand, because you must decide:"
    for check in advised:
        yield f"  {check.name} {check.where}".rstrip() + f": {check.line}"
        yield f"    {check.remedy}"


def _agreed(plan: Sequence[Repair], options: Options, *, yes: bool) -> bool:
    """Whether it is to be done: asked on a terminal alone."""
    if not plan or yes:
        return bool(plan)
    if options.as_json or not sys.stdin.isatty():
        warn("nothing was changed: there is no terminal to ask on; --yes does it", "not-confirmed")
        return False
    return confirm(f"Run {'this command' if len(plan) == 1 else f'these {len(plan)} commands'}?")


def _run(repair: Repair) -> bool:
    """Run one command; what it prints goes to standard error. Return whether it succeeded."""
    problem, limit = "", limits.DOCTOR_REPAIR
    try:
        if repair.do:
            repair.do()
        elif shutil.which(repair.words[0]) is None:
            problem = f"there is no {repair.words[0]} here; run it as root without it"
        else:
            out = sys.stderr.fileno()
            code = subprocess.run(repair.words, stdout=out, check=False, timeout=limit).returncode  # noqa: S603 - as shown
            problem = f"exit code {code}" if code else ""
    except subprocess.TimeoutExpired:
        problem = f"it did not end within {limit:.0f} s"
    except OSError as error:
        problem = error.strerror or str(error)
    if problem:
        warn(f"{repair}: {problem}", "failed")
    return not problem
