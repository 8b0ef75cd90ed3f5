"""``python -m lab bench|experiment``, from the root of a clone.

Exit codes: 0 done; 1 something could not be measured, and why is on stderr; 2 a command line or a run directory
cannot be used; 130 interrupted.
"""

from __future__ import annotations

import json
import os
import sys
from typing import TYPE_CHECKING, Final

import click

from lab.bench.commands import bench
from lab.experiments.commands import experiment
from rmpa.core.errors import ConfigError, RmpaError

if TYPE_CHECKING:
    from collections.abc import Sequence

PROGRAM: Final = "python -m lab"


@click.group(
    commands={"bench": bench, "experiment": experiment},
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
def lab() -> None:
    """Measure RMPA beside classic ROS and other middleware, on this machine."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line (default: ``sys.argv``); return the exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    try:
        code = lab.main(args=list(words), prog_name=PROGRAM, standalone_mode=False)
        sys.stdout.flush()
    except click.ClickException as error:
        error.show()
        return _failed(words, error.format_message(), error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        return 130
    except RmpaError as error:
        click.echo(f"lab: {error}", err=True)
        return _failed(words, str(error), 2 if isinstance(error, ConfigError) else 1)
    except BrokenPipeError:  # `| head`: what is left in the buffer must not fail again at the interpreter's end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    return code if isinstance(code, int) else 0


def _failed(words: Sequence[str], text: str, code: int) -> int:
    if "--json" in words and "experiment" in words:
        print(json.dumps({"error": text}), flush=True)
    return code


if __name__ == "__main__":
    sys.exit(main())
