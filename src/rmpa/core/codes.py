"""The codes of errors, warnings and problems: what each means, and what to do. ``rmpa explain CODE`` shows one.

A code stands in square brackets at the end of a line, and as ``code`` in JSON. It does not change between releases;
texts may. docs/reference/codes.md is made from ``CODES``, by ``make reference``.

A code is for what a user can do something else about, not for each line of the program that raises.
"""

from __future__ import annotations

import re
from typing import Final

# By code: what it means, and what to do.
CODES: Final[dict[str, tuple[str, str]]] = {
    # --- the command line and the settings
    "usage": (
        "The command line has an unknown command, option or argument, or one is missing.",
        "Read the command's `--help`. A shell completes the words: `rmpa completion --help`.",
    ),
    "invalid-value": (
        (
            "An option, an argument, a variable or a key of `rmpa.toml` has a value that cannot be used, or two of "
            "them exclude each other. In a file of Smart Resources: a declaration is wrong."
        ),
        (
            "Correct what the text names; a file is named with its line. `rmpa config show` prints where each "
            "setting comes from, [settings](settings.md) the values that each may have."
        ),
    ),
    "doubtful-setting": (
        (
            "A setting is accepted, but probably does not do what was meant: it has no effect, or another one "
            "outweighs it."
        ),
        "Change or remove what the text names. `rmpa config show` prints what holds and where it comes from.",
    ),
    "needs-restart": (
        "A setting was changed that takes effect only when the agent starts.",
        "Start the agent again: Ctrl-C and `rmpa up`, or `sudo systemctl restart rmpa`.",
    ),
    "unreadable-settings": (
        "`rmpa.toml` or another file of settings cannot be read, or is not TOML.",
        "Correct the line that the text names. `rmpa config show --config FILE` checks a file without a start.",
    ),
    "removed": (
        "The command, option, variable or key was in an older release, and is not in this one.",
        "Use what the text names instead.",
    ),
    "unknown-name": (
        "There is no peer, node, topic, service, parameter, resource or site of this name.",
        (
            "The text offers the nearest name; `rmpa topic list` and the other lists show all. Names of ROS begin "
            "with `/`; one of a peer is `PEER:/name`."
        ),
    ),
    "several-fit": (
        "The name fits several agents, peers or resources.",
        "Name one: `--agent NAME` or `RMPA_AGENT` for an agent, the GUID for a peer.",
    ),
    "not-confirmed": (
        "The command asks a question, and the answer was no, or there is no terminal to ask on.",
        "Answer `y`, or add `--yes` in a script.",
    ),
    "extra-missing": (
        "A part of RMPA that is installed on request is not installed.",
        "Run the command that the text names; [the extras](../start/install.md#the-extras).",
    ),
    "failed": (
        "What was asked for cannot be done; no other code fits.",
        "Do what the text says. `--json` gives the same text to programs.",
    ),
    # --- the start of a program
    "cannot-start": (
        "This machine does not allow the start as it was asked for.",
        "Do what the text says; `rmpa doctor` checks this machine.",
    ),
    "port-in-use": (
        (
            "A port or an address cannot be opened: another program has it, this machine does not have the address, "
            "or the port is below 1024 and the user is not root."
        ),
        (
            "End the program that the text names (`ss -lptun` names it too), or choose another port: `--core-port`, "
            "`--port`. To use a roscore that runs already: `--core external`."
        ),
    ),
    "name-in-use": (
        "An agent of this name runs on this machine already.",
        "Stop it, or give this one another `--name`. `rmpa doctor` lists the agents that run here.",
    ),
    "directory-unusable": (
        "A file or directory that RMPA needs cannot be made, read, written or removed, or belongs to another user.",
        "Correct its owner and rights, or name another one: `RMPA_STATE_DIR`, `RMPA_RUNTIME_DIR`. Is the disk full?",
    ),
    "no-state-directory": (
        "There is no directory to keep anything in: the user has no home.",
        "Set `RMPA_STATE_DIR` to a directory that this user may write.",
    ),
    "state-lost": (
        "What was kept of an earlier run cannot be used or written, wholly or in part.",
        (
            "The text names the file that was set aside. What is missing is registered again by the nodes that run. "
            "Is the disk full?"
        ),
    ),
    "service-unit": (
        "rmpa's unit of systemd cannot be installed, changed or started, or does not run as it should.",
        "`rmpa service status` shows its state and the end of its log; [at boot](../guides/running.md#at-boot).",
    ),
    "root-needed": (
        "Only root may do this.",
        "Repeat the command with `sudo`.",
    ),
    "realtime-denied": (
        (
            "The system does not grant the real-time priority or the locked memory that `--realtime` asks for. The "
            "agent runs without."
        ),
        "Grant it as the text says; [real time](../guides/running.md#real-time).",
    ),
    "out-of-descriptors": (
        (
            "The process has no file descriptor left. The last ones are kept for the ROS core and the links; further "
            "connections are refused."
        ),
        (
            "Raise the limit of open files: `LimitNOFILE=65536` in the systemd unit, or `ulimit -n 65536` in the "
            "shell that starts the agent."
        ),
    ),
    "ending-slowly": (
        "A part of the program does not end in the time that it has, and is left behind.",
        "Usually nothing. If a task of a Smart Resource blocks, let it return when it is cancelled.",
    ),
    "log-lines-lost": (
        "The program that reads the log stopped for a while, so some lines of it are lost.",
        "See why the reader (a pipe, a terminal, the journal) stopped. Messages of topics are not affected.",
    ),
    "watchdog": (
        "systemd cannot be told that the agent lives, so it may restart it.",
        "See that the unit has `NotifyAccess=main`, and that the socket of `$NOTIFY_SOCKET` can be written.",
    ),
    "internal-error": (
        "A fault in RMPA. The rest goes on; a traceback follows in the log.",
        "Report it with the lines of the log around it.",
    ),
    # --- agents, the core and nodes of this machine
    "no-agent": (
        "No agent answers on this machine, or this user may not ask it.",
        (
            "Start one: `rmpa up`. Started as a service of systemd: use `sudo`, or become a member of its group as "
            "the text says."
        ),
    ),
    "agent-trouble": (
        "The agent runs, and something about it is not as it should be.",
        "Do what the text says. Its log has more.",
    ),
    "master-unreachable": (
        "No ROS master answers at the address that is asked.",
        "Start `rmpa up` (or roscore), and see that `ROS_MASTER_URI` names it: `rmpa doctor`.",
    ),
    "core-refuses": (
        "The ROS master does not accept a registration of RMPA.",
        "The text is the master's reply. Is another agent at the same roscore? End one of both.",
    ),
    "core-slow": (
        (
            "The roscore that the agent uses does not answer, or answers too slowly. What flows goes on, and "
            "registrations are repeated."
        ),
        "See whether that roscore is stopped or overloaded.",
    ),
    "core-asked-to-end": (
        "A node asks the ROS core to end, which only a user may do.",
        "Nothing; to end the core, end `rmpa up`.",
    ),
    "node-unreachable": (
        "A node is registered and cannot be reached: it is dead, stopped, or listens at another address.",
        (
            "If it lives, start it with `ROS_IP=127.0.0.1` and without `ROS_HOSTNAME`: nodes talk over loopback, the "
            "agent carries what is for others. If it is dead, `rosnode cleanup` removes it."
        ),
    ),
    "node-gone": (
        "A node ended without telling the core, or its process is dead. Its registrations are removed.",
        "Nothing, if you ended it; else see why it ended.",
    ),
    "node-killed": (
        "A node was asked to end: by a peer that may do so, or because another node has taken its name.",
        "Give each node a name of its own. `[nodes] kill` in `rmpa.toml` says which nodes peers may end.",
    ),
    "name-taken": (
        "A node or service of this module has the name that one of a peer would get here.",
        "Give the peer a prefix, or rename one of them: [names](../guides/names.md).",
    ),
    "ros-environment": (
        "A ROS variable of this shell does not fit the agent.",
        "Set it as the text says.",
    ),
    "protocol-error": (
        (
            "The other side of a connection (a node, a peer, a client) sent what its protocol does not allow; or a "
            "program that is none of these, such as a port scanner, connected. The connection is closed."
        ),
        "If it repeats, see which program has the address that the text names.",
    ),
    "too-many-connections": (
        "A bound on connections or requests is reached; further ones are refused, or the idlest is closed.",
        "See which program at the address opens so many. [Limits](limits.md) lists the bounds.",
    ),
    "limit-reached": (
        (
            "There are more nodes, topics, services, parameters or bytes than a limit allows; what exceeds it is "
            "left out."
        ),
        "Raise the limit that the text names, or leave out what is not needed: [limits](limits.md).",
    ),
    # --- the network and peers
    "no-interface": (
        "An interface that agents could use is missing or down.",
        "`ip addr` shows the interfaces, `--interface` names those to use.",
    ),
    "multicast-blocked": (
        "Beacons by multicast are not sent or not received on an interface, so agents do not find each other there.",
        (
            "Let UDP and the multicast group through the firewall, or name one other module: `--seed HOST:PORT`. "
            "[Networks](../guides/networks.md)."
        ),
    ),
    "unresolved-name": (
        "The name of a seed or a host has no address.",
        "Correct the name, or write the address. It is tried again by itself.",
    ),
    "firewall-blocks": (
        "A rule of the firewall drops, or may drop, packets of agents.",
        "Let in the ports that the text names. A fixed port of the mesh: `rmpa up --port N`.",
    ),
    "rp-filter-strict": (
        "The kernel drops packets of peers that come in on another interface than the answer would leave by.",
        "`sudo sysctl -w net.ipv4.conf.all.rp_filter=2`, and for each interface.",
    ),
    "radio-slow": (
        "On this wireless interface lost packets are repeated late, or commands wait behind large messages.",
        "Run the command that the text names.",
    ),
    "no-route": (
        "The kernel has no route to a peer or a seed.",
        "`ip route get ADDRESS`: a gateway is missing, or the interface of that network is down.",
    ),
    "clock-skew": (
        (
            "The clock of this machine or of a peer is wrong: stamps and ages of messages of the other machine are "
            "wrong too."
        ),
        "Run chrony or systemd-timesyncd on both; `timedatectl` shows the state.",
    ),
    "peer-unlinked": (
        "A peer was found, and there is no link to it.",
        (
            "See that TCP gets through between both machines: firewall, routes. `rmpa why --module NAME` says where "
            "it stops."
        ),
    ),
    "peer-refused": (
        "A peer, or this module, refuses the link: another release, another domain, or the same module twice.",
        (
            "The text says why. Both machines need releases that fit each other ([compatibility](compatibility.md)) "
            "and the same `--domain`."
        ),
    ),
    "other-release": (
        "Another machine runs a release of RMPA with another format.",
        "Install the same release on both: [compatibility](compatibility.md).",
    ),
    "pending": (
        "A module without keys of this secured mesh asks to join it. Its name and address are not proved.",
        (
            "If it is yours: `rmpa trust invite --module NAME` at the authority, or the button of the page under "
            "control; then run on the module the line that is printed. If it is not, do nothing."
        ),
    ),
    "other-mesh": (
        "A module is not of this mesh: one of both has joined a secured mesh, or both have joined different ones.",
        (
            "At the authority `rmpa trust invite`, and on the module `rmpa trust join TOKEN`: "
            "[trust](../guides/trust.md)."
        ),
    ),
    "name-conflict": (
        "Two modules have the same name, GUID or address.",
        (
            "Give each module a `--name` of its own. After a copy of a disk, remove `module-name` in the state "
            "directory of one."
        ),
    ),
    "same-names": (
        "A peer has topics of the same names as this module, such as `/cmd_vel`: commands for one robot drive both.",
        "Run such robots with `rmpa up --prefix-peers`: [names](../guides/names.md).",
    ),
    "link-slow": (
        "The link to a peer is slower than what it should carry; messages were dropped.",
        (
            "`rmpa peer info NAME` shows of which topics; `max_rate`, `priority` or compression help: "
            "[contracts](../guides/contracts.md)."
        ),
    ),
    "unreachable": (
        "No program answers at an address where one should.",
        "See whether it runs there, and whether a firewall is between.",
    ),
    "refused": (
        "The other side (an agent, a peer, a node, a service) answered with a refusal.",
        "The text has its reason. Its own log may tell more.",
    ),
    # --- topics and services
    "no-publisher": (
        "The peer has no publisher of this topic.",
        "Is the node started, and the name right? `rmpa topic list` shows what peers offer.",
    ),
    "no-subscriber": (
        "No node here subscribes to the topic, so the peer does not send it.",
        "To try it: `rmpa topic echo PEER:/name`.",
    ),
    "subscriber-unconnected": (
        "A node here subscribes, and has not connected to the proxy of the publisher.",
        "See that node's log; its `ROS_MASTER_URI` and `ROS_IP` must be those of this machine.",
    ),
    "rule-excludes": (
        "A rule of `[bridge]`, `[services]` or a gateway keeps the name from crossing.",
        "Change the rule that the text names, and `rmpa reload`: [names](../guides/names.md).",
    ),
    "not-permitted": (
        "A `[[permission]]`, or a setting of the other side, does not allow this.",
        (
            "`rmpa trust check PEER ACCESS /name` names the rule, on the module that refuses: "
            "[permissions](../guides/trust.md#permissions)."
        ),
    ),
    "not-offered": (
        "The peer has the topic or service, and does not offer it to this module.",
        "The text says why. If it has just started, ask again in a moment.",
    ),
    "type-mismatch": (
        "Publisher and subscriber, or server and client, have different versions of a message or service.",
        "Build both sides with the same version of the package; `rosmsg md5 TYPE` on both shows whether it is.",
    ),
    "unknown-type": (
        "The definition of a message or service type is not known here, or is wrong.",
        "Source the workspace that has it where the program starts. A publisher of the type tells it too.",
    ),
    "invalid-message": (
        "Fields or bytes are not a message of this type.",
        "`rosmsg show TYPE` prints the fields.",
    ),
    "message-too-long": (
        "A message is longer than what crosses, and is left out; others come as usual.",
        "Send it in parts, or compressed: [limits](limits.md).",
    ),
    "route-not-open": (
        "The peer was asked for the topic, and does not send it.",
        "It is tried again by itself. `rmpa why PEER:/name` says where it stops.",
    ),
    "nothing-sent": (
        "The publisher is connected, and no message of it was sent, or not all.",
        "Look at that node on the peer: `rostopic hz`.",
    ),
    "nothing-arrives": (
        "The peer sends, and nothing arrives here, or nothing more.",
        "Is the link too slow? `rmpa peer info NAME`; is the publisher stopped?",
    ),
    "contract-missed": (
        "A topic does not keep its contract: messages were lost, late, too old, or a deadline was missed.",
        "`rmpa topic info` shows how many and when: [contracts](../guides/contracts.md).",
    ),
    "reader-slow": (
        "A subscriber or client does not read as fast as messages come; for it, some are dropped.",
        "Its callbacks are too slow, or it is stopped. No other subscriber waits for it.",
    ),
    "not-direct": (
        "The contract says `direct`, and a subscriber is relayed; or the other way round.",
        "The text names the condition: [contracts](../guides/contracts.md).",
    ),
    "stale-connections": (
        (
            "The agent may not end connections of nodes to a machine that has vanished; a publisher without "
            "queue_size, or a call, may hang."
        ),
        "Give the agent CAP_NET_ADMIN: [direct transport](../guides/running.md#direct-transport).",
    ),
    "no-server": (
        "No node provides this service, or its server does not answer.",
        "Is the node started? `rmpa service list` shows the services.",
    ),
    "service-failed": (
        "A call of a service failed: the server refused it, ended, or did not answer in time.",
        "The text is the server's. A longer time-out: `timeout` of [[service]], [services](../guides/services.md).",
    ),
    "param-trouble": (
        "A parameter is not followed, not told to peers, or not accepted.",
        "The text says why: [parameters](../guides/services.md).",
    ),
    # --- trust
    "trust-off": (
        "The mesh is not secured: every program that reaches the port may join it.",
        "On a network that others can reach: `rmpa trust init`, see [trust](../guides/trust.md).",
    ),
    "clock-not-set": (
        "The clock of this machine is not set, so no certificate can be judged.",
        "Set it: `timedatectl set-ntp true`, or `date -s`.",
    ),
    "keys-unusable": (
        "A key, certificate or list in the state directory is missing, broken, or readable by others.",
        "Do what the text says; if the files are lost, join again: [trust](../guides/trust.md).",
    ),
    "certificate-trouble": (
        "A certificate ends soon, has ended, or could not be renewed.",
        (
            "Start the authority's agent, and see that there is a link to it. `rmpa trust status` shows the dates; "
            "`rmpa trust renew` tries again."
        ),
    ),
    "certificate-refused": (
        "A certificate is not accepted: it is of another authority, of another name, of another time, or revoked.",
        "The text says which. `rmpa trust join` with a new token of the authority gives a new one.",
    ),
    "not-a-member": (
        "The module has joined no secured mesh, or its agent runs without.",
        "`rmpa trust init` makes a mesh, `rmpa trust join TOKEN` joins one; then start the agent again.",
    ),
    "already-a-member": (
        "The module is a member of a secured mesh already.",
        "`rmpa trust leave` removes its keys; then it can join another one.",
    ),
    "not-authority": (
        "Only the authority of the mesh can do this.",
        "Run the command there; `rmpa trust status` names it.",
    ),
    "token-refused": (
        "A token or a request to join is mistyped, used, withdrawn, too old, or of another release.",
        "Copy it again, or make a new one at the authority: `rmpa trust invite`.",
    ),
    "member-revoked": (
        "A module was revoked. It has no link, and the others have a new group key.",
        "Nothing, if you did it. To let it in again: `rmpa trust invite`.",
    ),
    "nodes-exposed": (
        "Other machines reach nodes of this secured module without any check, as ROS 1 has none.",
        (
            "Start the nodes with `ROS_IP=127.0.0.1`, or let a firewall drop what comes from outside: "
            "[security](security.md)."
        ),
    ),
    # --- the web server, gateways, resources
    "web-stopped": (
        "`rmpa web`, which the agent starts, has ended or cannot start.",
        "The lines of the log above it say why. `rmpa web` in a terminal shows the same.",
    ),
    "web-certificate": (
        "A certificate or key of `rmpa web` cannot be used.",
        "See `cert` and `key` of `[web]`: [web](../guides/web.md).",
    ),
    "web-client-refused": (
        "A page, a client of rosbridge or Foxglove, or a scraper is refused or disconnected.",
        "The text has its address and the reason: [web](../guides/web.md).",
    ),
    "site-unreachable": (
        "Another site, or its gateway, does not answer.",
        "`rmpa site list` shows the sites and their gateways: [sites](../guides/sites.md).",
    ),
    "zenoh-trouble": (
        "The gateway cannot reach a Zenoh router, or Zenoh did not send something.",
        "See the endpoints of `[gateway]`, and whether the router runs: [sites](../guides/sites.md).",
    ),
    "no-conversion": (
        "A type has no form in the other ROS, or a call between both failed.",
        "Write a mapping of its fields, or leave the topic out: [ROS 2](../guides/ros2.md).",
    ),
    "resource-trouble": (
        "A Smart Resource is not well: a task, a function or an input failed, or a requirement cannot be met.",
        (
            "`rmpa resource info` and `rmpa profile explain` show the state: [Smart "
            "Resources](../guides/smart-resources.md)."
        ),
    ),
}

# By the name of a check of ``rmpa doctor``, or of a stage of ``rmpa why``: the code of its warning or failure.
CHECKS: Final = {
    **dict.fromkeys(("settings",), "invalid-value"),
    **dict.fromkeys(("policy here", "policy there", "rule", "rule here", "shown"), "rule-excludes"),
    **dict.fromkeys(("permission here", "permission there"), "not-permitted"),
    **dict.fromkeys(("offer", "offers"), "not-offered"),
    **dict.fromkeys(("limit", "limits"), "limit-reached"),
    **dict.fromkeys(("type", "md5"), "type-mismatch"),
    **dict.fromkeys(("publisher", "source there"), "no-publisher"),
    **dict.fromkeys(("demand", "demand here"), "no-subscriber"),
    **dict.fromkeys(("peer", "link"), "peer-unlinked"),
    **dict.fromkeys(("lanes", "load"), "link-slow"),
    **dict.fromkeys(("node", "reachable"), "node-unreachable"),
    **dict.fromkeys(("multicast", "heard"), "multicast-blocked"),
    **dict.fromkeys(("answer", "calls"), "service-failed"),
    "agent": "agent-trouble",
    "directory": "directory-unusable",
    "interface": "no-interface",
    "firewall": "firewall-blocks",
    "rp_filter": "rp-filter-strict",
    "radio": "radio-slow",
    "port": "port-in-use",
    "ROS": "ros-environment",
    "clock": "clock-skew",
    "realtime": "realtime-denied",
    "boot": "service-unit",
    "exposed nodes": "nodes-exposed",
    "files": "out-of-descriptors",
    "trust": "certificate-trouble",
    "transport": "not-direct",
    "graph": "name-taken",
    "subscriber": "subscriber-unconnected",
    "route": "route-not-open",
    "sent": "nothing-sent",
    "arrived": "nothing-arrives",
    "contract": "contract-missed",
    "reader": "reader-slow",
    "server": "no-server",
    "site": "site-unreachable",
    "router": "zenoh-trouble",
}

# By the state of a peer that is not linked.
PEER_STATES: Final = {
    "linking": "peer-unlinked",
    "refused": "peer-refused",
    "conflict": "name-conflict",
    "foreign": "other-mesh",
    "pending": "pending",
    "revoked": "member-revoked",
}

# By a counter of refusals, or by its first words: the code of the line in the log.
_COUNTERS: Final = {
    "accept": "out-of-descriptors",
    "audience": "limit-reached",
    "beacon": "protocol-error",
    "beacon.clock": "clock-skew",
    "beacon.other_domain": "peer-refused",
    "beacon.flood": "too-many-connections",
    "beacon.forged": "other-mesh",
    "beacon.unknown_key": "other-mesh",
    "beacon.untagged": "other-mesh",
    "beacon.version": "other-release",
    "conflict": "name-conflict",
    "contract": "contract-missed",
    "control": "too-many-connections",
    "control.refused": "protocol-error",
    "control.user": "not-permitted",
    "descriptors": "out-of-descriptors",
    "direct": "not-direct",
    "http": "protocol-error",
    "http.evicted": "too-many-connections",
    "http.refused": "too-many-connections",
    "link": "protocol-error",
    "link.pending_full": "too-many-connections",
    "link.refused": "peer-refused",
    "message": "message-too-long",
    "mismatch": "type-mismatch",
    "names": "name-taken",
    "nodes": "limit-reached",
    "param": "param-trouble",
    "peer.twin": "same-names",
    "publication": "type-mismatch",
    "publisher": "protocol-error",
    "route": "contract-missed",
    "route.doubled": "protocol-error",
    "service": "type-mismatch",
    "services": "limit-reached",
    "sources": "limit-reached",
    "site": "other-release",
    "subscription": "type-mismatch",
    "tcpros": "protocol-error",
    "tcpros.refused.full": "too-many-connections",
    "topics": "limit-reached",
    "trust": "token-refused",
    "xmlrpc": "protocol-error",
    "zenoh": "limit-reached",
    **{
        f"link.refused.{reason}": code
        for reason, code in {
            "version": "other-release",
            "full": "limit-reached",
            "duplicate": "name-conflict",
            "plain": "other-mesh",
            "unsecured": "other-mesh",
            "key": "other-mesh",
            "foreign": "other-mesh",
            **dict.fromkeys(("clock", "expired", "revoked", "name", "downgrade"), "certificate-refused"),
        }.items()
    },
}


def of_counter(name: str) -> str:
    """The code of a line about a refusal, by the counter's name; those of the web server have no dot."""
    if "." not in name:
        return "web-client-refused"
    while name and name not in _COUNTERS:
        name = name.rpartition(".")[0]
    return _COUNTERS.get(name, "failed")


def of_line(text: str) -> str:
    """The code at the end of a line; empty where there is none."""
    found = re.search(r" \[([a-z][a-z0-9-]+)\]$", text)
    return found[1] if found else ""


def plain(text: str) -> str:
    """A text of the table without the Markdown of its links: ``limits (docs/reference/limits.md)``."""
    text = re.sub(r"\[([^\]]+)\]\(\.\./([^)]+)\)", r"\1 (docs/\2)", text)
    return re.sub(r"\[([^\]]+)\]\(([a-z]+\.md[^)]*)\)", r"\1 (docs/reference/\2)", text)
