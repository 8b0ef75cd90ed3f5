"""Files that this release cannot read."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.runtime.files import set_aside

if TYPE_CHECKING:
    from pathlib import Path


def test_of_files_set_aside_the_first_ones_stay_and_they_are_nine_at_most(tmp_path: Path) -> None:
    for number in range(12):
        path = tmp_path / "sonar.json"
        path.write_text(str(number))
        set_aside(path, "before")
    names = ["sonar.json.before", *(f"sonar.json.before-{number}" for number in range(2, 10))]
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == dict(
        zip(names, "01234567", strict=False)
    ) | {names[-1]: "11"}
