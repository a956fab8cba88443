"""Play an export for MuJoCo in Genesis on the processor, and compare its bodies with the truth.

    GENESIS_PYTHON tools/exports/with_genesis.py FOLDER

FOLDER has ``scene.xml`` and ``motion.npz`` of ``humansim export --format mujoco``. Genesis keeps mocap bodies
fixed: they get free joints here, and each frame sets the positions of all joints.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from xml.etree import ElementTree

import genesis
import numpy as np


def with_free_joints(model: Path) -> Path:
    """Write the model with free joints in place of mocap bodies."""
    tree = ElementTree.parse(model)
    for body in tree.iter("body"):
        if body.attrib.pop("mocap", None):
            body.set("gravcomp", "1")
            body.insert(0, ElementTree.Element("freejoint"))
            inertia = {"pos": "0 0 0", "mass": "1", "diaginertia": "0.01 0.01 0.01"}
            body.insert(1, ElementTree.Element("inertial", inertia))
    path = model.with_name("genesis.xml")
    tree.write(path)
    return path


def main(folder: Path) -> None:
    """Print how far bodies are from their poses in each frame."""
    genesis.init(backend=genesis.cpu, logging_level="error")
    options = genesis.options.RigidOptions(enable_collision=False)
    scene = genesis.Scene(show_viewer=False, rigid_options=options)
    world = scene.add_entity(genesis.morphs.MJCF(file=str(with_free_joints(folder / "scene.xml"))))
    start = time.monotonic()
    scene.build()
    print(f"built in {time.monotonic() - start:.0f} s: {len(world.links)} links, {world.n_qs} coordinates")
    with np.load(folder / "motion.npz") as motion:
        names, positions, rotations = motion["body"].tolist(), motion["mocap_pos"], motion["mocap_quat"]
    links = {link.name: link for link in world.links}
    coordinates = np.concatenate([positions, rotations], axis=-1)
    worst = 0.0
    for frame in coordinates:
        world.set_qpos(frame.ravel())
        found = np.array([links[name].get_pos().numpy() for name in names])
        worst = max(worst, float(np.abs(found - frame[:, :3]).max()))
    print(f"{len(coordinates)} frames, {len(names)} bodies: at most {worst:.1e} m")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
