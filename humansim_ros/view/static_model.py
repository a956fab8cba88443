"""Meshes that do not move as one glTF file for the page."""

from __future__ import annotations

import io
from collections.abc import Iterable

import numpy as np
import trimesh
from PIL import Image as PillowImage
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from humansim_ros.export.glb import split_seams
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.view.pictures import texture_jpeg

#: Longest side of a texture on the page, pixels.
_TEXTURE_SIDE = 512


def glb_of(meshes: Iterable[Mesh]) -> bytes:
    """glTF file (GLB) of meshes with their textures or colours; meshes of one texture are joined."""
    groups: dict[int, list[Mesh]] = {}
    single: list[Mesh] = []
    for mesh in meshes:
        if mesh.texture is not None and mesh.uv is not None:
            groups.setdefault(id(mesh.texture), []).append(mesh)
        else:
            single.append(mesh)
    scene = trimesh.Scene()
    for group in groups.values():
        scene.add_geometry(_textured(group))
    for mesh in single:
        colors = np.full((len(mesh.vertices), 3), 170, np.uint8) if mesh.colors is None else mesh.colors
        scene.add_geometry(
            trimesh.Trimesh(mesh.vertices, mesh.triangles, vertex_colors=colors, process=False)
        )
    return bytes(scene.export(file_type="glb"))


def _textured(meshes: list[Mesh]) -> trimesh.Trimesh:
    """One mesh of several with the same texture."""
    vertices, uvs, faces, count = [], [], [], 0
    for mesh in meshes:
        original, uv, triangles = split_seams(mesh)
        assert uv is not None
        vertices.append(mesh.vertices[original])
        uvs.append(uv)
        faces.append(triangles + count)
        count += len(original)
    texture = meshes[0].texture
    assert texture is not None
    image = PillowImage.open(io.BytesIO(texture_jpeg(texture, _TEXTURE_SIDE)))
    material = PBRMaterial(baseColorTexture=image, metallicFactor=0.0, roughnessFactor=0.9, doubleSided=False)
    visual = TextureVisuals(uv=np.concatenate(uvs), material=material)
    return trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), visual=visual, process=False)
