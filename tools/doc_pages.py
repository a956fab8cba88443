"""Write the parts of docs/ that come from tables of the code: ``python tools/doc_pages.py``.

docs/joints.md has the table of joint names; tools/reference_pages.py makes the pages of docs/reference/.
Tests compare the pages with the tables: run this program after you change a joint name, a scene key, a topic
or an option of a command.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tools")]

import reference_pages  # noqa: E402

_JOINTS_BEGIN = "<!-- joint names: tools/doc_pages.py -->"
_JOINTS_END = "<!-- end of the joint names -->"


def with_joint_names(page: str) -> str:
    """docs/joints.md with the table of joint names of today."""
    from humansim_ros.files.reading import read_table
    from humansim_ros.motion.body.skeleton import JOINT_NAMES, SETS

    def row(cells: Iterable[str]) -> str:
        return f"| {' | '.join(cells)} |"

    def code(name: str) -> str:
        return f"{'~' * name.startswith('~')}`{name.removeprefix('~')}`" if name else ""

    titles = ("joint", "place", "bone of this name", *SETS.values())
    lines = [row(titles), row("---" for _ in titles)]
    for joint in JOINT_NAMES:
        others = (code(joint.in_set(column)) for column in SETS)
        lines.append(row((code(joint.name), joint.place, joint.bone, *others)))
    lines += ["", "Without a joint here:", ""]
    for column in ("smpl", "coco", "body_25"):
        used = {getattr(joint, column) for joint in JOINT_NAMES}
        others = (code(name) for name in read_table("joints")[column] if name not in used)
        lines.append(f"- {SETS[column]}: {', '.join(others)}")
    before, _, rest = page.partition(_JOINTS_BEGIN)
    _, _, after = rest.partition(_JOINTS_END)
    return f"{before}{_JOINTS_BEGIN}\n\n" + "\n".join(lines) + f"\n\n{_JOINTS_END}{after}"


if __name__ == "__main__":
    joints = ROOT / "docs" / "joints.md"
    joints.write_text(with_joint_names(joints.read_text(encoding="utf-8")), encoding="utf-8")
    reference_pages.write()
