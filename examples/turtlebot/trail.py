"""Draws the robot's trail in characters: braille (2 by 4 dots each) where the terminal can, else ASCII."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

Point = tuple[float, float]
BRAILLE = 0x2800
DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
"""The bit of each dot, by row and column of a character."""
SMALLEST = 1.0
"""Metres that the drawing spans at least, so that a robot that stands still does not fill it."""
ARROWS = "→↗↑↖←↙↓↘"
PLAIN_ARROWS = ">/^\\</v\\"


def draw(points: Sequence[Point], heading: float, columns: int, rows: int, *, unicode: bool = True) -> list[str]:
    """Lines of ``columns`` characters, x to the right and y upwards, the robot an arrow at the last point.

    Args:
        points: Metres, oldest first.
        heading: Radians.
        columns: Characters in a line, at least 2.
        rows: Lines, at least 2.
        unicode: Whether to draw in braille.
    """
    across, down = (2, 4) if unicode else (1, 1)
    width, height = columns * across, rows * down
    cells = [[0] * columns for _ in range(rows)]
    if not points:
        return [" " * columns] * rows
    # A character is about twice as high as it is wide: in ASCII one unit of x is half a unit of y.
    place = _placing(points, width, height, 1.0 if unicode else 0.5)
    for point in points:
        column, row = place(point)
        cells[row // down][column // across] |= DOTS[row % down][column % across] if unicode else 1
    lines = [[_character(cell, unicode=unicode) for cell in line] for line in cells]
    column, row = place(points[-1])
    lines[row // down][column // across] = (ARROWS if unicode else PLAIN_ARROWS)[_eighth(heading)]
    return ["".join(line) for line in lines]


def _placing(points: Sequence[Point], width: int, height: int, aspect: float) -> Callable[[Point], tuple[int, int]]:
    """From metres to dots, with one scale for both directions and the drawing in the middle."""
    xs, ys = [p[0] for p in points], [p[1] for p in points]
    span_x, span_y = max(max(xs) - min(xs), SMALLEST), max(max(ys) - min(ys), SMALLEST)
    scale = min((width - 1) * aspect / span_x, (height - 1) / span_y)
    middle_x, middle_y = (max(xs) + min(xs)) / 2, (max(ys) + min(ys)) / 2

    def place(point: Point) -> tuple[int, int]:
        column = round((width - 1) / 2 + (point[0] - middle_x) * scale / aspect)
        row = round((height - 1) / 2 - (point[1] - middle_y) * scale)
        return max(0, min(width - 1, column)), max(0, min(height - 1, row))

    return place


def _character(cell: int, *, unicode: bool) -> str:
    if not cell:
        return " "
    return chr(BRAILLE + cell) if unicode else "."


def _eighth(heading: float) -> int:
    return round(heading / (math.tau / 8)) % 8
