"""Write motions of generated persons in formats of other programs, by the formulas of their documents.

The truth is :meth:`StandIn.positions`, the forward kinematics of the generator.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from motion_files import Array, Rotations, StandIn
from scipy.spatial.transform import Rotation

#: Metres of a unit of CMU's files.
CMU_UNIT = 0.0254 / 0.45


def write_acclaim(
    folder: Path,
    person: StandIn,
    rotations: Rotations,
    root: Array | None = None,
    *,
    stem: str = "walk",
    units: str = "deg",
    length: float = 0.45,
    unit: float = CMU_UNIT,
    order: str = "xyz",
    seed: int = 1,
    places: int = 9,
) -> Path:
    """Write an .asf and an .amc file whose bones have random axes. ``unit``: metres of a unit of the files.

    A joint with several children has a bone without length, and a bone without degrees of freedom to each
    child, as CMU's ``lhipjoint``.
    """
    axes = Rotation.random(len(person.names), random_state=seed)
    scale, angle = 0.01 / unit, 1.0 if units == "deg" else np.pi / 180
    local, place = person._frames(rotations, root)
    names = ["root", *person.names[1:]]
    bones, hierarchy = [], []

    def bone(name: str, along: Array, joint: int | None) -> None:
        size = float(np.linalg.norm(along))
        way = along / size if size else np.array([0.0, 1.0, 0.0])
        turn = np.zeros(3) if joint is None else axes[joint].as_euler(order, degrees=True) * angle
        dof = "" if joint is None else f"\n     dof {' '.join('r' + axis for axis in order)}"
        bones.append(
            f"  begin\n     id {len(bones) + 1}\n     name {name}\n"
            f"     direction {way[0]:.12g} {way[1]:.12g} {way[2]:.12g}\n     length {size * scale:.12g}\n"
            f"     axis {turn[0]:.12g} {turn[1]:.12g} {turn[2]:.12g} {order.upper()}{dof}\n  end"
        )

    for joint, name in enumerate(names):
        children = person.children(joint)
        single = joint > 0 and len(children) == 1
        along = person.offsets[children[0]] if single else np.array(person.ends.get(joint, np.zeros(3)))
        if joint > 0:
            bone(name, along, joint)
        if children and single:
            hierarchy.append(f"    {name} {names[children[0]]}")
        elif children:
            links = [f"{name}_to_{names[child]}" for child in children]
            for link, child in zip(links, children, strict=True):
                bone(link, person.offsets[child], None)
                hierarchy.append(f"    {link} {names[child]}")
            hierarchy.append(f"    {name} {' '.join(links)}")
    (folder / f"{stem}.asf").write_text(
        f"# made by a test\n:version 1.10\n:name someone\n:units\n  mass 1.0\n  length {length}\n"
        f"  angle {units}\n:documentation\n   none\n:root\n   order TX TY TZ RX RY RZ\n   axis XYZ\n"
        "   position 0 0 0\n   orientation 0 0 0\n:bonedata\n" + "\n".join(bones) + "\n:hierarchy\n  begin\n"
        + "\n".join(hierarchy) + "\n  end\n"
    )  # fmt: skip
    rows = [":FULLY-SPECIFIED", ":DEGREES" if units == "deg" else ":RADIANS"]
    for frame, turns in enumerate(local):
        rows.append(str(frame + 1))
        angles = Rotation.from_matrix(turns[0]).as_euler("xyz", degrees=True) * angle
        numbers = [*(place[frame] * scale), *angles]
        rows.append("root " + " ".join(f"{value:.{places}f}" for value in numbers))
        for joint in range(1, len(names)):
            # the world rotation below the parent's is C M C^-1
            own = axes[joint].inv() * Rotation.from_matrix(turns[joint]) * axes[joint]
            numbers = own.as_euler(order, degrees=True) * angle
            rows.append(f"{names[joint]} " + " ".join(f"{value:.{places}f}" for value in numbers))
    path = folder / f"{stem}.amc"
    path.write_text("\n".join(rows) + "\n")
    return path
