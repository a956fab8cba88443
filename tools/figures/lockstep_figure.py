"""Draw the sequence of a frame in lockstep (docs/images/lockstep.svg).

python tools/figures/lockstep_figure.py OUTPUT
"""

from __future__ import annotations

import sys
from pathlib import Path

from humansim_ros.files.reading.files import atomic_path

#: Lifelines from left to right, with the distance between them and from the left edge, pixels.
ACTORS = ("motion player", "skinners", "cameras", "tracker")
SPACING, LEFT, TOP, STEP = 210, 95, 64, 34
COLORS = ("#e8eef8", "#dfe9f7", "#d4ecdd", "#fbe9c8")
#: Rows: an arrow (from, to, text), a piece of work (actor, text, rows), or a line across all.
ARROWS: list[tuple[int, int, int, str]] = [
    (0, 0, 3, "/clock, scene_time: stamp k"),
    (1, 0, 1, "motion"),
    (3, 1, 2, "joints, vertices"),
    (6, 2, 3, "images, truth"),
    (7, 2, 0, "frame_done"),
    (9, 3, 0, "/tracker/poses, or frame_done"),
    (11, 0, 3, "/clock, scene_time: stamp k + 1"),
    (12, 0, 1, "motion"),
]
WORK: list[tuple[int, int, int, str]] = [
    (0, 1, 9, "computes k + 1"),
    (1, 1, 3, "skin"),
    (2, 3, 7, "render"),
    (3, 6, 9, "track"),
]


def x_of(actor: int) -> int:
    return LEFT + SPACING * actor


def y_of(row: int) -> int:
    return TOP + 40 + STEP * row


def drawing() -> str:
    """The picture as SVG."""
    width, height = x_of(len(ACTORS) - 1) + LEFT, y_of(12) + 44
    parts = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
            f'viewBox="0 0 {width} {height}" font-family="DejaVu Sans, Arial, sans-serif">'
        ),
        "<style>.name{font-weight:bold;font-size:15px;fill:#111827}.what{font-size:13px;fill:#374151}</style>",
        '<rect width="100%" height="100%" fill="white"/>',
    ]
    for actor, name in enumerate(ACTORS):
        x = x_of(actor)
        parts += [
            f'<line x1="{x}" y1="{TOP}" x2="{x}" y2="{height - 8}" stroke="#9ca3af" stroke-dasharray="4 4"/>',
            (
                f'<rect x="{x - 75}" y="20" width="150" height="36" rx="6" fill="{COLORS[actor]}" '
                'stroke="#6b7280"/>'
            ),
            f'<text x="{x}" y="43" class="name" text-anchor="middle">{name}</text>',
        ]
    for actor, begin, end, text in WORK:
        x, y = x_of(actor), y_of(begin)
        parts += [
            (
                f'<rect x="{x - 7}" y="{y}" width="14" height="{y_of(end) - y}" fill="{COLORS[actor]}" '
                'stroke="#6b7280"/>'
            ),
            f'<text x="{x + 14}" y="{(y + y_of(end)) // 2 + 4}" class="what">{text}</text>',
        ]
    for row, start, end, text in ARROWS:
        parts += arrow(y_of(row), start, end, text)
    y = y_of(10)
    parts += [
        f'<line x1="20" y1="{y}" x2="{width - 20}" y2="{y}" stroke="#b91c1c" stroke-dasharray="8 4"/>',
        f'<text x="{x_of(0) + 14}" y="{y - 6}" class="what">all members have finished frame k</text>',
    ]
    return "\n".join([*parts, "</svg>", ""])


def arrow(y: int, start: int, end: int, text: str) -> list[str]:
    """An arrow between two lifelines, with its text above it in the middle of its first gap."""
    side = 1 if end > start else -1
    anchor = "start" if side > 0 else "end"
    begin, tip = x_of(start) + 8 * side, x_of(end) - 8 * side
    return [
        f'<line x1="{begin}" y1="{y}" x2="{tip - 6 * side}" y2="{y}" stroke="#1f2937" stroke-width="1.5"/>',
        f'<path d="M{tip},{y} l{-9 * side},-4.5 v9 z" fill="#1f2937"/>',
        f'<text x="{x_of(start) + 14 * side}" y="{y - 6}" class="what" text-anchor="{anchor}">{text}</text>',
    ]


def main(output: Path) -> None:
    """Write the picture."""
    with atomic_path(output) as path:
        path.write_text(drawing())


if __name__ == "__main__":
    main(Path(sys.argv[1]))
