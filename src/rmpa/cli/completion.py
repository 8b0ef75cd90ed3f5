"""``rmpa completion``: completion in a shell, of commands, options, and the names that the agent knows."""

from __future__ import annotations

import contextlib
import os
import threading
from typing import TYPE_CHECKING, Final

import click
from click.shell_completion import BashComplete, get_completion_class

from rmpa.cli.options import Options, argument, verb
from rmpa.core.errors import RmpaError
from rmpa.core.identity import proxied_node, proxied_peer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.cli.graph import Graph

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


@verb(argument("shell", type=click.Choice(["bash", "zsh", "fish"])))
def completion(shell: str) -> None:
    """Print the script that completes commands, options, and the names that the agent knows, in a shell.

    ---

    Examples:
      eval "$(rmpa completion bash)"             in this shell; in ~/.bashrc for all
      rmpa completion zsh > "${fpath[1]}/_rmpa"
      mkdir -p ~/.config/fish/completions
      rmpa completion fish > ~/.config/fish/completions/rmpa.fish
    """
    from rmpa.cli.main import cli

    kind = get_completion_class(shell)
    assert kind is not None  # noqa: S101 - each of the choices has one
    # ``source()`` of bash's class would run bash to check its version; the template needs no shell.
    complete = kind(cli, {}, "rmpa", "_RMPA_COMPLETE")
    template = _BASH if isinstance(complete, BashComplete) else complete.source_template
    click.echo(template % complete.source_vars())


def names(kind: str, ctx: click.Context, incomplete: str) -> list[str]:
    """The names that begin as a user began to write; none where no agent or master answers in time.

    Args:
        kind: As for ``options.completes``.
        ctx: The command line so far.
        incomplete: The begun word.
    """
    found: list[str] = []

    def ask() -> None:
        with contextlib.suppress(RmpaError, OSError, ValueError):
            found.extend(name for name in _FIND[kind](ctx, incomplete) if name.startswith(incomplete))

    # Imported here, not in the thread: the time that this takes is not the agent's.
    from rmpa.cli import param, resource  # noqa: F401

    if kind in ("profile", "context"):
        from rmpa.ros.node import node  # noqa: F401 - it subscribes to a resource's description

    # In a thread, which the end of the program ends: an agent that hangs must not hold up the shell.
    asked = threading.Thread(target=ask, daemon=True)
    asked.start()
    asked.join(ANSWER)
    return sorted({*found})


def _options(ctx: click.Context) -> Options:
    return Options(as_json=False, agent=ctx.params.get("agent"), master_uri=ctx.params.get("master"))


def _graph(ctx: click.Context) -> Graph:
    return _options(ctx).graph()[1]


def _of_peer(name: str, node: str) -> str:
    """A name as a user writes it: ``PEER:/name`` if the node that offers it is a peer's proxy."""
    peer = proxied_peer(node)
    return name if peer is None else f"{peer}:{name}"


def _with_peers(found: dict[str, list[str]], incomplete: str) -> Iterable[str]:
    """Names, of this module and of its peers; ``PEER:/name`` too, unless a name without peer has been begun."""
    for name, nodes in found.items():
        yield name
        if not incomplete.startswith("/"):
            yield from (_of_peer(name, node) for node in nodes)


def _agents() -> Iterable[str]:
    from rmpa.observe.control_client import find_agents

    return [agent.name for agent in find_agents(os.environ)]


def _peers(ctx: click.Context) -> Iterable[str]:
    with _options(ctx).client(ANSWER) as client:
        return [peer.name for peer in client.snapshot(topics=()).peers]


def _nodes(ctx: click.Context) -> Iterable[str]:
    for node in _graph(ctx).nodes:
        proxy = proxied_node(node)
        yield node if proxy is None else _of_peer(proxy[1], node)


def _params(ctx: click.Context, incomplete: str) -> Iterable[str]:
    from rmpa.cli.param import open_store, split_peer, with_namespaces

    before = incomplete.partition(":")[0] + ":" if ":" in incomplete else ""
    peer, _ = split_peer(ctx.params.get("peer"), incomplete)
    for name in open_store(peer, _options(ctx)).names():
        yield from (before + each for each in with_namespaces(name))  # rosparam's verbs take namespaces too


def _resources(ctx: click.Context) -> Iterable[str]:
    from rmpa.resource.descriptor import TOPIC

    ending = f"/{TOPIC}"
    for topic, nodes in _graph(ctx).publishers.items():
        if topic.endswith(ending):
            yield from (_of_peer(topic.removesuffix(ending), node) for node in nodes)


def _choices(ctx: click.Context, what: str) -> Iterable[str]:
    """The profiles or contexts of the resource that stands before them in the line."""
    from rmpa.cli.resource import ResourceGraph, run_with_resources

    found: list[str] = []

    async def body(graph: ResourceGraph) -> None:
        one = graph.pick(ctx.params.get("resource")).descriptor
        found.extend(each.name for each in (one.profiles if what == "profile" else one.contexts))

    run_with_resources(_options(ctx), body)
    return found


_FIND: Final[dict[str, Callable[[click.Context, str], Iterable[str]]]] = {
    "agent": lambda _ctx, _: _agents(),
    "peer": lambda ctx, _: _peers(ctx),
    "topic": lambda ctx, text: _with_peers((graph := _graph(ctx)).subscribers | graph.publishers, text),
    "service": lambda ctx, text: _with_peers(_graph(ctx).services, text),
    "node": lambda ctx, _: _nodes(ctx),
    "param": _params,
    "resource": lambda ctx, _: _resources(ctx),
    "profile": lambda ctx, _: _choices(ctx, "profile"),
    "context": lambda ctx, _: _choices(ctx, "context"),
}
