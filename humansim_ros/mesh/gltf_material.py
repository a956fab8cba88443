"""How the materials of glTF files answer light; what of them is not shown is told."""

from __future__ import annotations

import numpy as np

from humansim_ros.errors import MeshError, warn_about
from humansim_ros.io.images import decode_alpha, decode_image
from humansim_ros.mesh.gltf_document import Gltf, GltfMaterial, TextureInfo
from humansim_ros.mesh.material import Material
from humansim_ros.types import Image

_REPEATED, _MIRRORED = 10497, 33648
_STRENGTH = "KHR_materials_emissive_strength"


def read_material(gltf: Gltf, number: int | None, laid: bool) -> Material:
    """The material of a number; the default one for None. ``laid``: there are coordinates for its textures.

    MeshError where an image is wrong.
    """
    material = gltf.material(number)
    pbr, base = material.pbrMetallicRoughness, material.pbrMetallicRoughness.baseColorTexture
    maps = {
        "metal and roughness": pbr.metallicRoughnessTexture,
        "normal map": material.normalTexture,
        "emission": material.emissiveTexture,
    }
    used = {what: info for what, info in maps.items() if info is not None}
    leading = base or next(iter(used.values()), None)
    doubts = _doubts(gltf, material, leading)
    images: dict[str, Image] = {}
    for what, info in used.items():
        if not laid:
            doubts.append(f"its {what} has no texture coordinates to lie on")
        elif leading is not None and _laying(info) != _laying(leading):
            doubts.append(f"its {what} lies otherwise than its colour")
        else:
            image = read_image(gltf, info)
            if image is not None:
                images[what] = image
    cut = None
    if material.alphaMode != "OPAQUE" and base is not None and laid:
        source = gltf.texture_image(base.index)
        cut = None if source is None else decode_alpha(gltf.image(source))
    for doubt in doubts:
        warn_about(gltf.path, f"material {material.name or number!r}: {doubt}: it is not shown")
    wraps = (_REPEATED, _REPEATED) if leading is None else gltf.wraps(leading.index)
    emissive_strength = float(_number(material.extensions.get(_STRENGTH), "emissiveStrength", 1.0))
    red, green, blue = np.maximum(np.array(material.emissiveFactor) * emissive_strength, 0.0).tolist()
    if material.emissiveTexture is not None and "emission" not in images:
        red = green = blue = 0.0
    return Material(
        metallic=_share(pbr.metallicFactor),
        roughness=_share(pbr.roughnessFactor),
        metal_rough=images.get("metal and roughness"),
        normals=images.get("normal map"),
        normal_scale=1.0 if material.normalTexture is None else material.normalTexture.scale,
        emission=(red, green, blue),
        emissive_map=images.get("emission"),
        alpha={"MASK": "mask", "BLEND": "blend"}.get(material.alphaMode, "opaque"),  # type: ignore[arg-type]
        cutoff=material.alphaCutoff,
        opacity=_share(pbr.baseColorFactor[3]),
        alpha_map=cut,
        double_sided=material.doubleSided,
        wrap=(wraps[0] != 33071, wraps[1] != 33071),
    )


def read_image(gltf: Gltf, info: TextureInfo) -> Image | None:
    """The image (H, W, 3) of a texture; None if it has none. MeshError with its key if it is damaged."""
    source = gltf.texture_image(info.index)
    if source is None:
        return None
    try:
        return decode_image(gltf.image(source))
    except MeshError as error:
        raise MeshError(error.message, path=gltf.path, key=error.key or f"images.{source}") from None


def _doubts(gltf: Gltf, material: GltfMaterial, leading: TextureInfo | None) -> list[str]:
    """What a material says that is not shown."""
    doubts = [f"extension {name!r}" for name in material.extensions if name != _STRENGTH]
    if material.occlusionTexture is not None:
        doubts.append("its map of ambient occlusion, which is found anew,")
    if leading is not None:
        doubts += [f"extension {name!r} of its texture" for name in leading.extensions]
        if _MIRRORED in gltf.wraps(leading.index):
            doubts.append("that its texture repeats mirrored")
    return doubts


def _laying(info: TextureInfo) -> tuple[int, str]:
    return info.texCoord, str(sorted(info.extensions.items()))


def _share(value: float) -> float:
    return min(max(value, 0.0), 1.0)


def _number(extension: object, key: str, default: float) -> float:
    value = extension.get(key, default) if isinstance(extension, dict) else default
    return float(value) if isinstance(value, (int, float)) and 0 <= value < 1e6 else default
