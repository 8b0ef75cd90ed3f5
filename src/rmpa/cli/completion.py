"""What a shell completes: the script of ``rmpa completion``, and the names that the agent or the master knows."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Final, TypeAlias

import click

from rmpa.cli.main import verb
from rmpa.core.errors import RmpaError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.cli.graph import Graph

# Finds names, for the command line so far and the begun word.
Find: TypeAlias = "Callable[[click.Context, str], Iterable[str]]"
# Seconds that the agent or master has for its answer: a person waits with the key pressed.
ANSWER: Final = 0.3
_BASH: Final = """\
%(complete_func)s() {
    local IFS=$'\\n' line=${COMP_LINE:0:COMP_POINT} words current number reply
    # bash takes PEER:/name for three words. These are those of the line, up to the cursor.
    IFS=' ' read -ra words <<< "$line"
    [[ $line == *' ' ]] && words+=('')
    current=${words[-1]}
    COMPREPLY=()
    number=$((${#words[@]} - 1))
    for reply in $(env COMP_WORDS="${words[*]}" COMP_CWORD=$number %(complete_var)s=bash_complete $1); do
        case ${reply%%%%,*} in
            dir) compopt -o dirnames ;;
            file) compopt -o default ;;
            *) reply=${reply#*,}
               [[ $current == *:* ]] && reply=${reply#"${current%%:*}:"}
               COMPREPLY+=("$reply") ;;
        esac
    done
}
complete -o nosort -F %(complete_func)s %(prog_name)s
"""


@verb(click.argument("shell", type=click.Choice(["bash", "zsh", "fish"])))
def completion(shell: str) -> None:
    """Print the script that completes commands, options, and the names that the agent knows, in a shell.

    ---

    Examples:
      eval "$(rmpa completion bash)"             in this shell; in ~/.bashrc for all
      rmpa completion zsh > "${fpath[1]}/_rmpa"
      mkdir -p ~/.config/fish/completions
      rmpa completion fish > ~/.config/fish/completions/rmpa.fish
    """
    from click.shell_completion import BashComplete, get_completion_class

    from rmpa.cli.main import cli

    kind = get_completion_class(shell)
    assert kind is not None  # noqa: S101 - each of the choices has one
    # ``source()`` of bash's class would run bash to check its version; the template needs no shell.
    complete = kind(cli, {}, "rmpa", "_RMPA_COMPLETE")
    template = _BASH if isinstance(complete, BashComplete) else complete.source_template
    click.echo(template % complete.source_vars())


def completes(find: Find, *modules: str) -> Callable[[click.Context, click.Parameter, str], list[str]]:
    """A function for ``shell_complete`` of an argument or option: the names that begin as a user began to write.

    There are none where no agent or master answers in time.

    Args:
        find: Finds the names.
        modules: What it imports: the time that this takes is not the agent's.
    """

    def complete(ctx: click.Context, _: click.Parameter, incomplete: str) -> list[str]:
        import contextlib
        import importlib
        import threading

        found: set[str] = set()

        def ask() -> None:
            with contextlib.suppress(RmpaError, OSError, ValueError):
                found.update(name for name in find(ctx, incomplete) if name.startswith(incomplete))

        for module in ("asyncio", "rmpa.cli.graph", "rmpa.ros.http.rpc", *modules):
            importlib.import_module(module)
        # In a thread, which the end of the program ends: an agent that hangs must not hold up the shell.
        asked = threading.Thread(target=ask, daemon=True)
        asked.start()
        asked.join(ANSWER)
        return sorted(found)

    return complete


def graph_of(ctx: click.Context) -> Graph:
    """The graph of the master that a command line means."""
    import asyncio

    from rmpa.cli.graph import choose_master, read_graph

    return asyncio.run(read_graph(choose_master(ctx.params.get("master"), ctx.params.get("agent"), os.environ)))


def of_peer(name: str, node: str) -> str:
    """A name as a user writes it: ``PEER:/name`` if the node that offers it is a peer's proxy."""
    from rmpa.core.identity import proxied_peer

    peer = proxied_peer(node)
    return name if peer is None else f"{peer}:{name}"


def _with_peers(found: dict[str, list[str]], incomplete: str) -> Iterable[str]:
    """Names, of this module and of its peers; ``PEER:/name`` too, unless a name without peer has been begun."""
    for name, nodes in found.items():
        yield name
        if not incomplete.startswith("/"):
            yield from (of_peer(name, node) for node in nodes)


def agents(_: click.Context, __: str) -> Iterable[str]:
    """Agents of this machine."""
    from rmpa.observe.control_client import find_agents

    return [agent.name for agent in find_agents(os.environ)]


def peers(ctx: click.Context, _: str) -> Iterable[str]:
    """Modules that the agent knows."""
    from rmpa.observe.control_client import ControlClient, choose_agent

    with ControlClient(choose_agent(os.environ, ctx.params.get("agent")).path, ANSWER) as client:
        return [peer.name for peer in client.snapshot(topics=()).peers]


def topics(ctx: click.Context, incomplete: str) -> Iterable[str]:
    """Topics of the graph."""
    graph = graph_of(ctx)
    return _with_peers(graph.subscribers | graph.publishers, incomplete)


def services(ctx: click.Context, incomplete: str) -> Iterable[str]:
    """Services of the graph."""
    return _with_peers(graph_of(ctx).services, incomplete)


def nodes(ctx: click.Context, _: str) -> Iterable[str]:
    """Nodes of the graph."""
    from rmpa.core.identity import proxied_node

    for node in graph_of(ctx).nodes:
        proxy = proxied_node(node)
        yield node if proxy is None else of_peer(proxy[1], node)
