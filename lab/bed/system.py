"""What experiments ask of the bed: systems of several hosts, classic or RMPA, and nodes on them.

Who implements it: ``bed.hosts`` (network namespaces with Debian's ROS) and ``bed.loopback`` (all on this machine,
with our own nodes and core).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, Protocol

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from contextlib import AbstractContextManager
    from pathlib import Path

    from lab.bed.processes import Process
    from lab.experiments.model import Client, Plan

Kind = Literal["classic", "rmpa"]
"""One roscore for all, or one agent and core on each host."""


class System(Protocol):
    """Some hosts that run, as one robot."""

    @property
    def kind(self) -> Kind:
        """Which of the two."""
        ...

    @property
    def hosts(self) -> Sequence[str]:
        """Their names."""
        ...

    @property
    def master(self) -> str:
        """The host of the one master; empty where each has its own."""
        ...

    def node(self, host: str, program: str, client: Client, *, wait: bool = True, **options: object) -> Process:
        """Start one of our nodes on a host: ``source``, ``velocity`` or ``sink``.

        Args:
            host: Where.
            program: Which.
            client: With which library.
            wait: Whether to return only when it said ``up``: one whose master is away never does.
            options: Its options: ``topic="/cmd"``, ``nodelay=True``.
        """
        ...

    def pids(self) -> Mapping[str, int]:
        """What of the system itself runs (masters, agents), by a name that a table can have: ``agent@base``."""
        ...

    def kill(self, host: str) -> None:
        """End a host as a pulled plug does: every process there at once by SIGKILL, and its cable is out."""
        ...

    def start(self, host: str) -> float:
        """Switch a killed host on again: cable, then agent or master; its nodes are the caller's to start.

        Returns when the agent is ready, or the master answers, and says when that was executed (``time.monotonic``);
        at once where a host has neither.
        """
        ...

    def linked(self) -> float:
        """Wait until every agent is linked with every other; the time (``time.monotonic``) of the last link.

        Classic: until the master answers, and when it was seen to.
        """
        ...

    def cut(self, host: str) -> None:
        """Pull its cable out; does nothing where there are no cables (see ``can_cut``)."""
        ...

    def restore(self, host: str) -> None:
        """Put its cable in again."""
        ...

    @property
    def can_cut(self) -> bool:
        """Whether there are cables."""
        ...

    def traffic(self, host: str) -> Mapping[str, int]:
        """Packets and bytes of a host's cable so far: ``tx_bytes``, ``rx_bytes``, ``tx_packets``, ``rx_packets``."""
        ...


class Stage(Protocol):
    """Where one cell is measured; all that was started on it has ended when the cell is over."""

    @property
    def plan(self) -> Plan:
        """What the run was asked for."""
        ...

    @property
    def scratch(self) -> Path:
        """An empty directory for files between nodes and us."""
        ...

    def system(
        self,
        kind: Kind,
        hosts: Sequence[str],
        *,
        link: str | None = None,
        bands: bool = True,
        config: str = "",
        flags: Sequence[str] = (),
        linked: bool = True,
    ) -> AbstractContextManager[System]:
        """Set a system up; it is torn down at the end of the ``with``.

        Args:
            kind: Which.
            hosts: Their names; classic's roscore runs on ``pc``, else on the last.
            link: What each cable carries (``100mbit``); empty for unshaped; ``None``: as the plan says.
            bands: Whether packets leave by the kernel's usual three bands (``pfifo_fast``), as on a real interface.
            config: Text of every agent's ``rmpa.toml``.
            flags: Further words for ``rmpa up``.
            linked: Whether to wait until every agent is linked with every other (classic: until the master answers).
        """
        ...
