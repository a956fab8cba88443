"""Hash of a scene, by which recordings and exports recognise it."""

from __future__ import annotations

import hashlib

from humansim_ros.errors import SceneError
from humansim_ros.io.files import read_blocks
from humansim_ros.scene.config import map_files
from humansim_ros.scene.scene import Scene


def scene_hash(scene: Scene) -> str:
    """Hash of a scene: its settings, and the content of the files that they name."""
    digest = hashlib.sha256(scene.config.model_dump_json().encode())

    def add(name: str) -> str:
        path = scene.source.folder / name.split("#")[0]
        if path.is_file():
            digest.update(f"{name}\n".encode())
            for block in read_blocks(path, SceneError, "scene"):
                digest.update(block)
        return name

    map_files(scene.config.model_dump(exclude_none=True), add)
    return digest.hexdigest()
