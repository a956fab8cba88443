"""Materials of glTF files, with warnings about unsupported parts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from pydantic import ValidationError

from humansim_ros.errors import MeshError, warn_about
from humansim_ros.io.schema_errors import schema_error
from humansim_ros.mesh.gltf_document import Gltf
from humansim_ros.mesh.gltf_schema import GltfMaterial, TextureInfo, TextureTransform
from humansim_ros.mesh.material import Material
from humansim_ros.types import Image

_REPEATED, _MIRRORED, _CLAMPED = 10497, 33648, 33071
_TRANSFORM = "KHR_texture_transform"
_EMISSIVE_STRENGTH = "KHR_materials_emissive_strength"


def read_material(gltf: Gltf, number: int | None, has_uv: bool) -> Material:
    """Read a material; None is the default material. ``has_uv``: the mesh has texture coordinates.

    Raises MeshError if an image is wrong.
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
    ignored = _unsupported(gltf, material, leading)
    images: dict[str, Image] = {}
    for what, info in used.items():
        if not has_uv:
            ignored.append(f"the {what}, because the mesh has no texture coordinates")
        elif leading is not None and _mapping(info) != _mapping(leading):
            ignored.append(f"the {what}, because its texture coordinates are not those of the colour")
        else:
            image = read_image(gltf, info)
            if image is not None:
                images[what] = image
    alpha_map = None
    if material.alphaMode != "OPAQUE" and base is not None and has_uv:
        alpha_map = _read_alpha(gltf, base)
    for part in ignored:
        warn_about(gltf.path, f"material {material.name or number!r}: ignored: {part}")
    wraps = (_REPEATED, _REPEATED) if leading is None else gltf.wraps(leading.index)
    emissive_strength = float(
        _extension_number(material.extensions.get(_EMISSIVE_STRENGTH), "emissiveStrength", 1.0)
    )
    red, green, blue = np.maximum(np.array(material.emissiveFactor) * emissive_strength, 0.0).tolist()
    if material.emissiveTexture is not None and "emission" not in images:
        red = green = blue = 0.0
    return Material(
        metallic=_clamp(pbr.metallicFactor),
        roughness=_clamp(pbr.roughnessFactor),
        metal_rough=images.get("metal and roughness"),
        normals=images.get("normal map"),
        normal_scale=1.0 if material.normalTexture is None else material.normalTexture.scale,
        emission=(red, green, blue),
        emissive_map=images.get("emission"),
        alpha={"MASK": "mask", "BLEND": "blend"}.get(material.alphaMode, "opaque"),  # type: ignore[arg-type]
        cutoff=material.alphaCutoff,
        opacity=_clamp(pbr.baseColorFactor[3]),
        alpha_map=alpha_map,
        double_sided=material.doubleSided,
        wrap=(wraps[0] != _CLAMPED, wraps[1] != _CLAMPED),
    )


def read_image(gltf: Gltf, info: TextureInfo) -> Image | None:
    """Image (H, W, 3) of a texture; None if it has none. Raises MeshError with the key if it is damaged."""
    return _decoded(gltf, info, gltf.decoded_images.get)


def _read_alpha(gltf: Gltf, info: TextureInfo) -> Image | None:
    """Alpha channel (H, W) of a texture; None if it has none. Raises MeshError as :func:`read_image`."""
    return _decoded(gltf, info, gltf.decoded_images.alpha)


def _decoded(
    gltf: Gltf, info: TextureInfo, decode: Callable[[int, Callable[[], bytes]], Image | None]
) -> Image | None:
    """Result of ``decode`` for the image of a texture, with path and key in errors."""
    source = gltf.texture_image(info.index)
    if source is None:
        return None
    try:
        return decode(source, lambda: gltf.image(source))
    except MeshError as error:
        raise MeshError(error.message, path=gltf.path, key=error.key or f"images.{source}") from None


def texture_transform(gltf: Gltf, info: TextureInfo) -> TextureTransform | None:
    """Transform of the texture coordinates of a texture; None without one. Raises MeshError."""
    if _TRANSFORM not in info.extensions:
        return None
    try:
        return TextureTransform.model_validate(info.extensions[_TRANSFORM])
    except ValidationError as reason:
        fault = schema_error(reason, TextureTransform, MeshError).within(_TRANSFORM)
        raise MeshError(fault.message, path=gltf.path, key=fault.key) from None


def _unsupported(gltf: Gltf, material: GltfMaterial, leading: TextureInfo | None) -> list[str]:
    """Parts of a material that are ignored."""
    parts = [f"extension {name!r}" for name in material.extensions if name != _EMISSIVE_STRENGTH]
    if material.occlusionTexture is not None:
        parts.append("the ambient occlusion map (ambient occlusion is computed)")
    if leading is not None:
        parts += [f"extension {name!r} of its texture" for name in leading.extensions if name != _TRANSFORM]
        if _MIRRORED in gltf.wraps(leading.index):
            parts.append("mirrored repetition of the texture")
    return parts


def _mapping(info: TextureInfo) -> tuple[int, str]:
    return info.texCoord, str(sorted(info.extensions.items()))


def _clamp(value: float) -> float:
    return min(max(value, 0.0), 1.0)


def _extension_number(extension: object, key: str, default: float) -> float:
    value = extension.get(key, default) if isinstance(extension, dict) else default
    return float(value) if isinstance(value, (int, float)) and 0 <= value < 1e6 else default
