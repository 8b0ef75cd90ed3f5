"""Flags that several commands share."""

from __future__ import annotations

import functools
import importlib
import math
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import click

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.cli.graph import Graph
    from rmpa.cli.master import Master

_T = TypeVar("_T")


def completes(kind: str) -> Callable[[click.Context, click.Parameter, str], list[str]]:
    """A function that completes names in a shell, for ``shell_complete`` of an argument or option.

    Args:
        kind: ``peer``, ``agent``, ``topic``, ``service``, ``node``, ``param``, ``resource``, ``profile`` or
            ``context``. Of a peer's own names, ``PEER:/name``, those of that peer are offered.
    """

    def complete(ctx: click.Context, _: click.Parameter, incomplete: str) -> list[str]:
        # By its name, as commands are: it asks the agent by the modules of the commands, which import this one.
        found: list[str] = importlib.import_module("rmpa.cli.completion").names(kind, ctx, incomplete)
        return found

    return complete


json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON; a stream prints one object a line.")
agent_option = click.option(
    "--agent",
    metavar="NAME",
    shell_complete=completes("agent"),
    help="Which agent of this machine to ask, if several run. [env: RMPA_AGENT]",
)
_master_option = click.option(
    "--master", metavar="URI", help="The ROS master to ask. [default: see rmpa topic --help]"
)


class FiniteRange(click.FloatRange):
    """A number in a range. Unlike click's own type it refuses ``nan``, which lies in every range, and ``inf``."""

    def convert(self, value: float, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Read the number.

        Raises:
            click.BadParameter: It is none, is not finite, or out of range.
        """
        found = super().convert(value, param, ctx)
        if not math.isfinite(found):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return found


@dataclass(frozen=True, slots=True)
class GraphOptions:
    """The values of ``--json``, ``--agent`` and ``--master`` of one command line."""

    as_json: bool
    agent: str | None
    master_uri: str | None

    def master(self) -> Master:
        """The master that is meant.

        Raises:
            RmpaError: As ``choose_master``.
        """
        from rmpa.cli.master import choose_master

        return choose_master(self.master_uri, self.agent, os.environ)

    def graph(self) -> tuple[Master, Graph]:
        """The master that is meant, and its graph.

        Raises:
            RmpaError: As ``choose_master`` and ``read_graph``.
        """
        import asyncio

        from rmpa.cli.graph import read_graph

        master = self.master()
        return master, asyncio.run(read_graph(master))


def graph_options(function: Callable[..., _T]) -> Callable[..., _T]:
    """Decorate a command with ``--json``, ``--agent`` and ``--master``: it gets them as its argument ``options``."""

    @functools.wraps(function)
    def command(*, as_json: bool, agent: str | None, master: str | None, **arguments: object) -> _T:
        return function(**arguments, options=GraphOptions(as_json, agent, master))

    return json_option(agent_option(_master_option(command)))
