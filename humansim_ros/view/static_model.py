"""Meshes that do not move as one glTF file for the page."""

from __future__ import annotations

import io
from collections.abc import Iterable

import cv2
import numpy as np
import trimesh
from PIL import Image as PillowImage
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from humansim_ros.export.glb import split_seams
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.types import Image

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
    material = PBRMaterial(
        baseColorTexture=_jpeg(texture), metallicFactor=0.0, roughnessFactor=0.9, doubleSided=False
    )
    visual = TextureVisuals(uv=np.concatenate(uvs), material=material)
    return trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), visual=visual, process=False)


def _jpeg(image: Image) -> PillowImage.Image:
    scale = _TEXTURE_SIDE / max(image.shape[:2])
    if scale < 1:
        image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])[1]
    return PillowImage.open(io.BytesIO(bytes(data)))
