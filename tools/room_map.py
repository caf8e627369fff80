"""The picture in docs/architecture.md: the packages of ``mrgs``, drawn from their imports.

``python tools/room_map.py`` writes docs/images/architecture.svg; a test compares them.
"""

from __future__ import annotations

import ast
import re
from functools import cache
from html import escape
from pathlib import Path
from statistics import fmean

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "mrgs"
PAGE = ROOT / "docs" / "architecture.md"
PICTURE = ROOT / "docs" / "images" / "architecture.svg"

COLORS = ("#cfe2ff", "#d8f3dc", "#ffe5cc", "#e9ecef")
"""One fill per group of packages, in the order of the page's tables."""

WIDTH, BOX_WIDTH, BOX_HEIGHT, ROW = 880, 104, 34, 66


@cache
def groups() -> dict[str, list[str]]:
    """The packages under each heading of docs/architecture.md whose table lists them."""
    found: dict[str, list[str]] = {}
    heading = ""
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            heading = line.removeprefix("### ")
        elif not heading.startswith("#") and (match := re.match(r"\| `(\w+)(?:/|\.py)` \|", line)):
            found.setdefault(heading, []).append(match[1])
    return found


@cache
def tree(path: Path) -> ast.Module:
    """What a file says."""
    return ast.parse(path.read_text(encoding="utf-8"), path.name)


@cache
def nodes(within: ast.AST) -> list[ast.AST]:
    """All nodes of a tree."""
    return list(ast.walk(within))


@cache
def imports() -> dict[str, set[str]]:
    """The other packages that each package imports, wherever in its files."""
    graph: dict[str, set[str]] = {}
    for path in sorted(SOURCE.rglob("*.py")):
        room = path.relative_to(SOURCE).parts[0].removesuffix(".py")
        if room in {"__init__", "__main__"}:
            continue
        targets = graph.setdefault(room, set())
        for node in nodes(tree(path)):
            names: list[str] = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            targets |= {name.split(".")[1] for name in names if name.startswith("mrgs.")}
        targets.discard(room)
    return {room: targets & graph.keys() for room, targets in graph.items()}


def floors(graph: dict[str, set[str]]) -> dict[str, int]:
    """The length of the longest chain of imports below each package.

    Raises:
        RecursionError: packages import each other in a circle.
    """

    @cache
    def floor(room: str) -> int:
        return max((floor(target) + 1 for target in graph[room]), default=0)

    return {room: floor(room) for room in graph}


def direct(graph: dict[str, set[str]]) -> dict[str, set[str]]:
    """The imports that no longer chain of imports implies (the transitive reduction)."""

    @cache
    def below(room: str) -> frozenset[str]:
        return frozenset(graph[room]).union(*(below(target) for target in graph[room]))

    return {
        room: {t for t in targets if not any(t in below(other) for other in targets)}
        for room, targets in graph.items()
    }


def positions(graph: dict[str, set[str]]) -> dict[str, tuple[float, float]]:
    """The middle of each package's box: the floors from top to bottom, and on each floor the
    packages ordered by the mean position of their neighbours."""
    height = floors(graph)
    rows = [
        sorted(room for room in graph if height[room] == level)
        for level in range(max(height.values()), -1, -1)
    ]
    users = {room: {other for other in graph if room in graph[other]} for room in graph}
    x: dict[str, float] = {}

    def place(row: list[str]) -> None:
        for index, room in enumerate(row):
            x[room] = WIDTH * (index + 0.5) / len(row)

    for row in rows:
        place(row)
    for sweep in range(20):
        neighbours = graph if sweep % 2 else users
        for row in rows if sweep % 2 == 0 else rows[::-1]:
            means = {
                # Rounded once, so that it does not depend on the order of a set.
                room: fmean(x[n] for n in neighbours[room] or (room,))
                for room in row
            }
            row.sort(key=lambda room: (means[room], room))
            place(row)
    return {room: (x[room], ROW * (level + 0.6)) for level, row in enumerate(rows) for room in row}


def picture() -> str:
    """The map as SVG."""
    graph = direct(imports())
    place = positions(graph)
    colors = {
        room: color
        for rooms, color in zip(groups().values(), COLORS, strict=True)
        for room in rooms
    }
    height = max(y for _, y in place.values()) + 0.6 * ROW + 20 * len(COLORS) / 2
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height:.0f}" '
        'font-family="sans-serif" font-size="14" text-anchor="middle">',
        '<rect width="100%" height="100%" fill="#ffffff"/>',
    ]
    for room, targets in graph.items():
        (x0, y0) = place[room]
        for x1, y1 in (place[target] for target in sorted(targets)):
            top, bottom = y0 + BOX_HEIGHT / 2, y1 - BOX_HEIGHT / 2
            bend = (bottom - top) / 2
            parts.append(
                f'<path d="M{x0:.0f} {top:.0f}C{x0:.0f} {top + bend:.0f} {x1:.0f} '
                f'{bottom - bend:.0f} {x1:.0f} {bottom:.0f}" fill="none" stroke="#868e96"/>'
            )
    for room, (x0, y0) in sorted(place.items()):
        parts.append(
            f'<rect x="{x0 - BOX_WIDTH / 2:.0f}" y="{y0 - BOX_HEIGHT / 2:.0f}" '
            f'width="{BOX_WIDTH}" height="{BOX_HEIGHT}" rx="5" fill="{colors[room]}" '
            f'stroke="#495057"/><text x="{x0:.0f}" y="{y0 + 5:.0f}">{room}</text>'
        )
    for index, (heading, color) in enumerate(zip(groups(), COLORS, strict=True)):
        x0 = WIDTH * (index + 0.5) / len(COLORS)
        parts.append(
            f'<rect x="{x0 - 100:.0f}" y="{height - 24:.0f}" width="14" height="14" '
            f'fill="{color}" stroke="#495057"/><text x="{x0 - 80:.0f}" y="{height - 12:.0f}" '
            f'text-anchor="start">{escape(heading)}</text>'
        )
    return "\n".join([*parts, "</svg>", ""])


if __name__ == "__main__":
    PICTURE.write_text(picture(), encoding="utf-8")
