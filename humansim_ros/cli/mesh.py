"""The ``humansim mesh`` commands: list the built-in meshes for objects of a scene."""

from __future__ import annotations

from collections.abc import Callable

from humansim_ros.cli.options import JsonOption
from humansim_ros.cli.output import print_text, to_json


def list_meshes(as_json: JsonOption = False) -> None:
    """List the built-in meshes, which objects of a scene may use by name."""
    from humansim_ros.scene.furniture import FURNITURE
    from humansim_ros.scene.objects import BUILT_IN_MESHES, SHAPES

    if as_json:
        meshes = {
            name: FURNITURE[name].mesh() if name in FURNITURE else SHAPES[name]() for name in BUILT_IN_MESHES
        }
        facts = [
            {
                "name": name,
                "description": BUILT_IN_MESHES[name],
                "low": mesh.vertices.min(0).round(6).tolist(),
                "high": mesh.vertices.max(0).round(6).tolist(),
            }
            for name, mesh in meshes.items()
        ]
        print_text(to_json(facts))
        return
    width = max(map(len, BUILT_IN_MESHES))
    for name, description in BUILT_IN_MESHES.items():
        print_text(f"{name:{width}}  {description}")


#: Commands of this module by name.
COMMANDS: dict[str, Callable[..., None]] = {"list": list_meshes}
