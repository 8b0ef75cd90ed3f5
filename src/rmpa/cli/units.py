"""What runs RMPA at boot: the units of systemd, their drop-ins, and ``/etc/rmpa/rmpa.toml``.

``rmpa service install`` writes these texts, and so does the build of the Debian package:

::

    from rmpa.cli.units import config_text, unit_texts

    for name, text in unit_texts("/usr/bin/rmpa").items(): ...  # rmpa.service, rmpa-web.service, rmpa-gateway.service
    config_text()                                               # /etc/rmpa/rmpa.toml

A key that is newer than the system's systemd is left out there, and said in the journal; none of the others needs it.
"""

from __future__ import annotations

import re
from importlib.resources import files
from typing import Final

# The user and group of the units, and their directories.
USER: Final = "rmpa"
GROUP: Final = "rmpa"
RUNTIME: Final = "/run/rmpa"
STATE: Final = "/var/lib/rmpa"
CONFIG: Final = "/etc/rmpa/rmpa.toml"
# The program of the Debian package, which has man pages.
PACKAGED: Final = "/usr/bin/rmpa"
# By the command behind ``rmpa``: its unit.
UNITS: Final = {"up": "rmpa.service", "web": "rmpa-web.service", "gateway": "rmpa-gateway.service"}
# The drop-ins of the agent's unit, by the option of ``rmpa service install``; below the folder of units.
DROP_INS: Final = {"realtime": "rmpa.service.d/realtime.conf", "resources": "rmpa.service.d/resources.conf"}

_DESCRIPTIONS: Final = {
    "up": "RMPA agent: this module's ROS core and its place in the mesh",
    "web": "RMPA web server: metrics, REST and pages of this machine's module",
    "gateway": "RMPA gateway: joins this network's modules with other sites and with ROS 2",
}
_UNIT: Final = """\
[Unit]
Description={description}
{documentation}# Interfaces that come later are followed: there is no need for network-online.target.
After=network.target{after}
# It is started again however often it fails, except for settings that it cannot run with.
StartLimitIntervalSec=0

[Service]
Type=notify
ExecStart={program} {command} --config {config}
# It waits for the answer, and fails with what the settings lack.
{reload}
Restart=always
RestartSec=0.5
RestartPreventExitStatus=2
# An event loop that hangs for so long is ended, and started again.
WatchdogSec=10
TimeoutStopSec=15
KillMode=mixed
User={user}
Group={group}
# The control sockets. They are found without a setting; members of the group may use them.
RuntimeDirectory=rmpa
RuntimeDirectoryMode=0750
RuntimeDirectoryPreserve=yes
# What is kept over a restart: registrations, the module's name, keys of a secured mesh.
StateDirectory=rmpa
StateDirectoryMode=0700
Environment=RMPA_RUNTIME_DIR={runtime} RMPA_STATE_DIR={state} RMPA_CONTROL_GROUP={group}
# Variables of yours, such as ROS_PACKAGE_PATH.
EnvironmentFile=-/etc/default/rmpa
SyslogIdentifier={identifier}
# Sockets, mostly: one for each connection of a node.
LimitNOFILE=65536
{capabilities}
# Nothing of the system but the network.
UMask=0077
NoNewPrivileges=yes
ProtectSystem=strict
ProtectHome=read-only
PrivateTmp=yes
PrivateDevices=yes
PrivateMounts=yes
ProtectClock=yes
ProtectControlGroups=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
ProtectProc=invisible
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
LockPersonality=yes
MemoryDenyWriteExecute=yes
RemoveIPC=yes
SystemCallArchitectures=native
SystemCallErrorNumber=EPERM
# A list of what is denied: older versions of systemd do not know the groups that a list of what is allowed needs.
SystemCallFilter=~@clock @cpu-emulation @debug @module @mount @obsolete @raw-io @reboot @swap

[Install]
WantedBy=multi-user.target
"""
# The agent's alone.
_NET_ADMIN: Final = """\
# To end connections whose host has vanished (docs/guides/direct-transport.md#cap_net_admin).
AmbientCapabilities=CAP_NET_ADMIN
CapabilityBoundingSet=CAP_NET_ADMIN"""
_DROP_INS: Final = {
    "realtime": """\
# rmpa up --realtime (docs/guides/running.md#real-time).
[Service]
Environment=RMPA_REALTIME=true
LimitRTPRIO=50
LimitMEMLOCK=infinity
RestrictRealtime=no
""",
    "resources": """\
# Nodes that the agent starts ([resources] in rmpa.toml) may use devices, CAN and compilers at run time, and go on
# when the agent is killed. Which devices is said by groups: sudo usermod -aG video,dialout USER of the unit.
[Service]
PrivateDevices=no
MemoryDenyWriteExecute=no
RestrictAddressFamilies=
KillMode=process
""",
}
_SETTING: Final = re.compile(r"^(?=[a-z_]+ = )", re.MULTILINE)
_HEADING: Final = """\
# rmpa.toml: the settings of this machine's module. To change one, remove the "# " in front of it. Where two lines
# have one key, the first is the default and the second an example. After a change: sudo systemctl reload rmpa
# docs/ is /usr/share/doc/rmpa/docs with the Debian package, else a folder of the repository.
"""


def unit_texts(program: str = PACKAGED, user: str = USER) -> dict[str, str]:
    """The units, by their file's name.

    Args:
        program: The absolute path of ``rmpa``.
        user: The user whose rights they have; its group is ``GROUP`` in any case.
    """
    quoted = program.replace("%", "%%").replace(" ", "\\x20")
    return {
        unit: _UNIT.format(
            description=_DESCRIPTIONS[command],
            documentation="Documentation=man:rmpa(1)\n" if program == PACKAGED else "",
            after="" if command == "up" else f" {UNITS['up']}",
            program=quoted,
            command=command,
            config=CONFIG,
            reload="\n".join(f"ExecReload={words}" for words in _reload(command, quoted)),
            user=user,
            group=GROUP,
            runtime=RUNTIME,
            state=STATE,
            identifier=unit.removesuffix(".service"),
            capabilities=_NET_ADMIN if command == "up" else "CapabilityBoundingSet=",
        )
        for command, unit in UNITS.items()
    }


def _reload(command: str, program: str) -> tuple[str, ...]:
    """The commands that have the process of a unit read its settings again; the web server has no control socket."""
    if command == "web":
        return f"{program} web --config {CONFIG} --check", "/bin/kill -HUP $MAINPID"
    return (f"{program} reload --agent $MAINPID",)


def drop_in_text(option: str, header: str = "") -> str:
    """The drop-in of an option of ``DROP_INS``."""
    return header + _DROP_INS[option]


def config_text() -> str:
    """A first ``rmpa.toml``: every setting with its default, each in a comment, so that later defaults hold."""
    _, _, rest = (files("rmpa.config") / "rmpa.toml").read_text("utf-8").partition("\n")
    return _HEADING + _SETTING.sub("# ", rest)
