"""The groups of commands: ``rmpa topic``, ``rmpa node`` and so on, with the module of each command."""

from __future__ import annotations

from typing import Final

from rmpa.cli.lazy_group import LazyGroup

_MASTER: Final = """\
The master: --master, else the core of --agent (or RMPA_AGENT), else ROS_MASTER_URI, else the core of the only
agent of this machine, else http://localhost:11311.
"""
_RESOURCE: Final = (
    "\b\nA resource is written as its node, /sonar; PEER:/sonar is that peer's. See rmpa resource --help.\n"
)


def _group(help_text: str, modules: dict[str, dict[str, str]], epilog: str = "") -> LazyGroup:
    """A group of commands.

    Args:
        help_text: What ``--help`` of the group shows.
        modules: By module of ``rmpa.cli``: its commands, each with the line that the group's help shows.
        epilog: Shown behind the commands.
    """
    commands_at = {
        name: (f"rmpa.cli.{module}", line) for module, commands in modules.items() for name, line in commands.items()
    }
    return LazyGroup(commands_at=commands_at, help=help_text, epilog=epilog)


peer: Final = _group(
    "See the peers that the agent knows.",
    {
        "peer": {
            "list": "List the peers, and how their links are.",
            "info": "Show all that is known of one peer.",
            "ping": "Measure the round trip to a peer over the mesh.",
        }
    },
)
topic: Final = _group(
    "See topics, listen to them, publish on them; no ROS installation is needed.",
    {
        "topic_graph": {
            "list": "List topics; those of peers with the peers' names.",
            "info": "Show a topic's type, publishers and subscribers, and what of it crosses.",
            "type": "Print a topic's type.",
            "find": "Print the topics of a type.",
        },
        "topic_echo": {"echo": "Print messages."},
        "topic_watch": {
            "hz": "Show how often messages come.",
            "bw": "Show how many bytes they need.",
            "delay": "Show how old they are when they come; over the mesh by the link's clock too.",
        },
        "topic_pub": {"pub": "Publish messages."},
    },
    f"\b\nA topic is written /name; PEER:/name means the sources of one peer alone.\n{_MASTER}",
)
service: Final = _group(
    "See services, and call them; no ROS installation is needed.",
    {
        "service_graph": {
            "list": "List services; those of peers with the peers' names.",
            "info": "Show a service's node, address, type and arguments, and what of it crosses.",
            "type": "Print a service's type.",
            "find": "Print the services of a type.",
        },
        "service_call": {"call": "Call a service."},
    },
    f"\b\nA service is written /name; PEER:/name means the service of that peer alone.\n{_MASTER}",
)
node: Final = _group(
    "See nodes, here and in other modules; ping and end them. No ROS installation is needed.",
    {
        "node_graph": {
            "list": "List nodes; those of peers as PEER:/node.",
            "info": "Show a node's module, address, process, topics and services.",
        },
        "node_calls": {"ping": "Ask whether a node answers, and how fast.", "kill": "End nodes."},
    },
    "\b\nA node is written /name; PEER:/name means that one peer's. A proxy's name, /rmpa/PEER/name, means the "
    f"same.\n{_MASTER}",
)
param: Final = _group(
    "See and set parameters, here or at a peer; no ROS installation is needed.",
    {
        "param": {
            "get": "Print a parameter, or a namespace of them.",
            "set": "Set a parameter, or the members of a namespace.",
            "list": "List the names of parameters.",
            "delete": "Delete a parameter, or a namespace of them.",
            "dump": "Write parameters as YAML.",
            "load": "Set parameters from YAML.",
            "followed": "List the parameters of other modules that this one follows ([[param]]).",
        }
    },
    """\
\b
With --peer the parameters of that peer's module are meant; its [params] say what others may read and set.
The master without it: --master, else the core of --agent (or RMPA_AGENT), else ROS_MASTER_URI, else the core of
the only agent of this machine, else http://localhost:11311. YAML is read and written as rosparam does.
""",
)
resource: Final = _group(
    "See Smart Resources, here or at a peer.",
    {
        "resource_list": {"list": "List resources; those of peers with the peers' names."},
        "resource_info": {
            "info": "Show all of a resource: topics, parameters, qualities, profiles, contexts, clients."
        },
    },
    "\b\nA resource is written as its node, /sonar; PEER:/sonar is that peer's. It may be left out where there is "
    f"only one.\n{_MASTER}",
)
profile: Final = _group(
    "See and choose the System Profile of a resource, here or at a peer.",
    {
        "profile": {
            "list": "List a resource's profiles and what they offer.",
            "get": "Print the profile that runs.",
            "set": "Choose a profile by hand, or let the resource decide again.",
            "explain": "Show each term of the last decision.",
        }
    },
    _RESOURCE,
)
context: Final = _group(
    "See and choose the context of a resource, here or at a peer.",
    {
        "context": {
            "list": "List a resource's contexts, their rules and what they require.",
            "get": "Print the present context; an empty line for none.",
            "set": "Choose a context by hand, or let the rules decide again.",
        }
    },
    _RESOURCE,
)
alarm: Final = _group(
    "See the alarms of resources, here and at peers.",
    {
        "alarm": {
            "list": "List the resources that are not well at present.",
            "echo": "Print alarms as they are raised and cleared, until Ctrl-C.",
        }
    },
    _RESOURCE,
)
site: Final = _group(
    "See other sites that gateways join.",
    {
        "site": {
            "list": "List this site and the others, and how they are.",
            "info": "Show the modules of a site and what they offer.",
        }
    },
    """\
\b
Any module of a site can ask: the gateways that it is linked to answer.
Parameters of another site's module: `rmpa param get --peer SITE/MODULE /name`.
Why something does not come from a site: `rmpa why /name`.
""",
)
trust: Final = _group(
    "Secure the mesh: who may join, and what other modules may do here.",
    {
        "trust_mesh": {
            "init": "Make a secured mesh, with this module as its authority.",
            "status": "Show certificate, keys and deny list; at the authority members and tokens.",
            "renew": "Renew the certificate now, or the group key of all.",
            "revoke": "Throw a module out of the mesh, at the authority.",
            "leave": "Remove this module's keys and certificate.",
        },
        "trust_join": {
            "invite": "Invite a module, at the authority: print a token, and wait.",
            "join": "Join a secured mesh with a token, or by files.",
        },
        "trust": {
            "check": "Say whether a peer may do something here, and by which rule.",
        },
    },
    "\b\nA walk-through, a fleet's provisioning, and what to do when keys are lost: docs/trust.md\n",
)
