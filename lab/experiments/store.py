"""A run directory: ``manifest.json``, and ``EXPERIMENT/CELL/TABLE.csv`` for all that was measured.

Files are replaced whole, and a cell counts once the manifest says so: whatever ends a run, what is there is sound,
and the next one goes on behind it.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import fcntl
import json
import os
from typing import TYPE_CHECKING, Final, Self

import msgspec

from lab import frames
from lab.experiments.manifest import FORMAT, CellRecord, Manifest, Session
from lab.experiments.model import Cell, Measured, Results
from rmpa.core.errors import ConfigError, StartError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from pandas import DataFrame

    from lab.bed.plan import Plan
    from lab.experiments.code import Code

_MANIFEST: Final = "manifest.json"
_LOCK: Final = ".lock"
# Facts of the machine that must not change within a run.
_SAME_MACHINE: Final = ("cpu", "cores", "kernel", "python", "roscpp", "rospy")
# Characters of a directory's name; file systems take 255 bytes.
_LONGEST_NAME: Final = 200


class Store:
    """One run directory.

    Args:
        directory: Where it is; made with the first thing that is kept.
        manifest: What it says of itself.
    """

    def __init__(self, directory: Path, manifest: Manifest) -> None:
        self.directory = directory
        self.manifest = manifest

    @classmethod
    def create(cls, directory: Path, plan: Plan, code: Code, machine: Mapping[str, object]) -> Self:
        """Begin a run.

        Raises:
            ConfigError: The directory has other things in it.
            StartError: It cannot be written to.
        """
        if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
            raise ConfigError("--out", f"{directory} is not empty, and no run directory", "name a new one")
        store = cls(directory, Manifest(plan=plan, code=code, machine=_plain(machine)))
        try:
            directory.mkdir(parents=True, exist_ok=True)
            store.save()
        except OSError as error:
            raise StartError(
                str(directory), f"cannot be written to ({error.strerror})", "name another with --out"
            ) from None
        return store

    @classmethod
    def load(cls, directory: Path) -> Self:
        """Open a run directory, to read it or to go on.

        Raises:
            ConfigError: It is none, or none that this version can read.
        """
        path = directory / _MANIFEST
        try:
            manifest = msgspec.json.decode(path.read_bytes(), type=Manifest)
        except (FileNotFoundError, NotADirectoryError):
            raise ConfigError(
                str(directory), "is no run directory (it has no manifest.json)", "make experiment makes one"
            ) from None
        except OSError as error:
            raise ConfigError(str(path), f"cannot be read ({error.strerror})") from None
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise ConfigError(str(path), f"is no manifest of a run ({error})") from None
        if manifest.format != FORMAT:
            raise ConfigError(str(path), f"has format {manifest.format}; this version of rmpa reads {FORMAT}")
        return cls(directory, manifest)

    @property
    def plan(self) -> Plan:
        """What was asked for."""
        return self.manifest.plan

    @property
    def names(self) -> list[str]:
        """The experiments in it, in their order."""
        return list(self.manifest.titles)

    # --- measuring ----------------------------------------------------------------------------------------------

    def require(self, plan: Plan, code: Code, machine: Mapping[str, object]) -> None:
        """Make sure that what is to be measured now may stand beside what is there.

        Raises:
            ConfigError: It may not, and why.
        """
        remedy = "name a new directory"
        had, want = msgspec.to_builtins(self.plan), msgspec.to_builtins(plan)
        if other := [
            f"{name} {_shown(had[name])}, not {_shown(want[name])}" for name in want if had[name] != want[name]
        ]:
            raise ConfigError("--out", f"{self.directory} was planned otherwise: {'; '.join(other)}", remedy)
        if self.manifest.code.digest != code.digest:
            raise ConfigError(
                "--out",
                f"{self.directory} was measured by other code ({_named(self.manifest.code)}, now {_named(code)}), "
                "and one run's figures must come of one",
                remedy,
            )
        was, now = self.manifest.machine, _plain(machine)
        if other := [
            f"{name} {was.get(name)}, now {now.get(name)}" for name in _SAME_MACHINE if was.get(name) != now.get(name)
        ]:
            raise ConfigError("--out", f"{self.directory} was measured elsewhere: {'; '.join(other)}", remedy)

    @contextlib.contextmanager
    def session(self, argv: Sequence[str]) -> Iterator[None]:
        """Record one call of the program around what it measures; the directory is locked meanwhile.

        Raises:
            StartError: Another process measures into it, or it cannot be written to.
        """
        try:
            lock = os.open(self.directory / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise StartError(str(self.directory), f"cannot be written to ({error.strerror})") from None
        try:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise StartError(str(self.directory), "another run measures into it") from None
            this = Session(argv=list(argv), began=utc(), load=os.getloadavg())
            self.manifest.sessions.append(this)
            self.save()
            try:
                yield
                this.end = "finished"
            except BaseException:
                this.end = "interrupted"
                raise
            finally:
                this.ended = utc()
                self.save()
        finally:
            os.close(lock)

    def expect(self, experiment: str, title: str, cells: Sequence[Cell]) -> None:
        """Note cells that are going to be measured, unless they are known.

        Raises:
            ValueError: Two have one key, or a key is no name for a directory.
        """
        self.manifest.titles[experiment] = title
        keys = [cell.key for cell in cells]
        if twice := sorted({key for key in keys if keys.count(key) > 1}):
            raise ValueError(f"{experiment} has two cells {twice[0]}")
        for cell in cells:
            if (
                "/" in cell.key
                or cell.key.startswith(".")
                or len(cell.key) > _LONGEST_NAME
                or cell.experiment != experiment
            ):
                raise ValueError(f"{cell.key!r} is no key for a cell of {experiment}")
            self.manifest.cells.setdefault(
                _id(cell),
                CellRecord(experiment=experiment, settings=dict(cell.settings), expected=cell.seconds),
            )
        self.save()

    def is_done(self, cell: Cell) -> bool:
        """Whether a cell was measured."""
        record = self.manifest.cells.get(_id(cell))
        return record is not None and record.state == "done"

    def note(
        self,
        cell: Cell,
        measured: Measured | None,
        *,
        began: str = "",
        seconds: float = 0.0,
        attempts: int = 1,
        error: str = "",
    ) -> None:
        """Keep what came of a cell.

        Args:
            cell: Which.
            measured: What came; ``None``: it could not be measured.
            began: UTC, ISO 8601.
            seconds: That it took.
            attempts: How often it was tried.
            error: Why the last attempt that failed did.

        Raises:
            ValueError: A table cannot be kept as CSV.
        """
        came = measured or Measured()
        held = {name: frames.kinds(table) for name, table in came.tables.items()}
        folder = self.directory / cell.experiment / cell.key
        folder.mkdir(parents=True, exist_ok=True)
        for name, table in came.tables.items():
            unfinished = folder / f"{name}.unfinished"
            with unfinished.open("w", encoding="utf-8", newline="") as file:
                frames.write(file, table)
            unfinished.replace(folder / f"{name}.csv")
        self.manifest.cells[_id(cell)] = msgspec.structs.replace(
            self.manifest.cells[_id(cell)],
            state="failed" if measured is None else "done",
            began=began,
            seconds=round(seconds, 3),
            attempts=attempts,
            facts=dict(came.facts),
            tables=held,
            error=error,
        )
        self.save()

    def save(self) -> None:
        """Write the manifest."""
        unfinished = self.directory / ".manifest.unfinished"
        unfinished.write_bytes(msgspec.json.format(msgspec.json.encode(self.manifest), indent=1) + b"\n")
        unfinished.replace(self.directory / _MANIFEST)

    # --- reading ------------------------------------------------------------------------------------------------

    def results(self, experiment: str) -> Results:
        """All that was measured of an experiment, in the order of its cells.

        Raises:
            ConfigError: A file is missing, or not what was written.
        """
        cells = [
            (cell, Measured(self._tables(cell, record), record.facts))
            for cell, record in self._records(experiment)
            if record.state == "done"
        ]
        return Results(self.plan, cells)

    def records(self, experiment: str, state: str) -> list[CellRecord]:
        """The cells of an experiment in this state."""
        return [record for _, record in self._records(experiment) if record.state == state]

    def _records(self, experiment: str) -> list[tuple[Cell, CellRecord]]:
        return [
            (Cell(experiment, record.settings, record.expected), record)
            for record in self.manifest.cells.values()
            if record.experiment == experiment
        ]

    def _tables(self, cell: Cell, record: CellRecord) -> dict[str, DataFrame]:
        tables = {}
        for name, held in record.tables.items():
            path = self.directory / cell.experiment / cell.key / f"{name}.csv"
            try:
                with path.open(encoding="utf-8", newline="") as file:
                    tables[name] = frames.read(file, held)
            except OSError as error:
                raise ConfigError(str(path), f"cannot be read ({error.strerror})") from None
            except ValueError as error:
                raise ConfigError(str(path), f"is not what was measured: {error}") from None
        return tables


def is_run_directory(directory: Path) -> bool:
    """Whether a run was begun there."""
    return (directory / _MANIFEST).exists()


def utc() -> str:
    """Now, as manifests have it."""
    return dt.datetime.now(dt.UTC).isoformat(timespec="seconds")


def _id(cell: Cell) -> str:
    return f"{cell.experiment}/{cell.key}"


def _plain(machine: Mapping[str, object]) -> dict[str, object]:
    """The same as JSON gives it back."""
    plain: dict[str, object] = json.loads(msgspec.json.encode(machine))
    return plain


def _named(code: Code) -> str:
    return f"{code.version} {code.commit or code.digest}{' with changes' if code.changed else ''}"


def _shown(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value) or "none"
