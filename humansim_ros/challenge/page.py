"""The pages of a challenge: the picture, and one HTML page that loads nothing else."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path

from humansim_ros.challenge.picture import picture
from humansim_ros.challenge.results import CaseResult, Report
from humansim_ros.io.files import atomic_path

#: Files of a report for people.
PICTURE, PAGE = "challenge.svg", "index.html"
_STYLE = """
body { font: 15px/1.5 Inter, 'Segoe UI', sans-serif; color: #1d2433;
  max-width: 1180px; margin: 24px auto; padding: 0 16px; }
svg { max-width: 100%; height: auto; } table { border-collapse: collapse; width: 100%; font-size: 13px; }
td, th { padding: 4px 10px 4px 0; text-align: left; border-bottom: 1px solid #e6e9ef; } th { color: #6b7385; }
.broken td { color: #b3324b; } h2 { margin: 36px 0 8px; }
"""


def _millimetres(value: float | None) -> str:
    return "–" if value is None else f"{1000 * value:.1f} mm"


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{value:.1%}"


_COLUMNS: dict[str, Callable[[CaseResult], str]] = {
    "score": lambda r: f"{r.score:.1f}",
    "error (MPJPE)": lambda r: _millimetres(r.mpjpe),
    "joints within 150 mm": lambda r: _percent(r.pck),
    "people found": lambda r: _percent(r.recall),
    "found people who are real": lambda r: _percent(r.precision),
    "IDF1": lambda r: _percent(r.idf1),
    "switches": lambda r: "–" if r.switches is None else str(r.switches),
    "frames with estimate": lambda r: f"{r.estimates} of {r.frames}",
    "latency": lambda r: "–" if r.latency is None else f"{1000 * r.latency:.0f} ms",
    "failure": lambda r: r.failure,
}


def write_pages(folder: Path, report: Report, other: Report | None = None) -> Sequence[Path]:
    """Write the picture and the page into the folder of a report.

    Returns:
        Their paths.

    Raises:
        HumansimError: A file cannot be written.
    """
    contents = {PICTURE: picture(report, other), PAGE: page(report, other)}
    for name, content in contents.items():
        with atomic_path(folder / name) as temporary:
            temporary.write_text(content, encoding="utf-8")
    return [folder / name for name in contents]


def page(report: Report, other: Report | None = None) -> str:
    """The page as HTML: the picture, and all numbers of all cases."""
    reports = {"": report} if other is None else {"A: ": report, "B: ": other}
    tables = (
        f"<h2>{escape(name)}{escape(each.tracker)}</h2>{_table(each)}" for name, each in reports.items()
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>Crash test of a tracker</title>'
        f"<style>{_STYLE}</style></head>\n<body>{picture(report, other)}{''.join(tables)}</body></html>\n"
    )


def _table(report: Report) -> str:
    head = "".join(f"<th>{escape(name)}</th>" for name in ("case", "strength", *_COLUMNS))
    rows = []
    for result in report.results.values():
        info = report.axes.get(result.axis)
        cells = (
            "Baseline" if info is None else info.title,
            result.label if result.strength else "",
            *(show(result) for show in _COLUMNS.values()),
        )
        kind = ' class="broken"' if report.is_broken(result) else ""
        rows.append(f"<tr{kind}>{''.join(f'<td>{escape(cell)}</td>' for cell in cells)}</tr>")
    return f"<table><tr>{head}</tr>{''.join(rows)}</table>"
