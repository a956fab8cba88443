"""Materials of OBJ meshes (.mtl): colours, and how they reflect light."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from humansim_ros.errors import MeshError, warn_about
from humansim_ros.io.files import exists, read_bytes, read_text, resolve_inside
from humansim_ros.io.images import MAX_IMAGE_BYTES, DecodedImages
from humansim_ros.mesh.atlas import plain_tile
from humansim_ros.mesh.material import Material, height_to_normal_map
from humansim_ros.types import Array, Image

#: Keyword -> line number and words after it, of one material. The last statement of a keyword counts.
Statements = Mapping[str, tuple[int, list[str]]]
#: Specular reflectance (F0) of Ks 1. Ks 0.5 is glass and plastic (F0 0.04), as in Blender.
_SPECULAR = 0.08
#: Largest material file: thousands of materials.
MAX_BYTES = 16 << 20
_NORMAL_MAPS = ("norm", "map_Bump", "map_bump", "bump")
_UNSUPPORTED = ("map_Ks", "map_Ns", "map_Pr", "map_Pm", "map_Ps", "disp", "refl", "decal")


def read_mtl(path: Path) -> dict[str, Statements]:
    """Statements of a material file by material name."""
    materials: dict[str, dict[str, tuple[int, list[str]]]] = {}
    for number, line in enumerate(read_text(path, MeshError, "material", MAX_BYTES).splitlines(), 1):
        words = line.partition("#")[0].split()
        if words and words[0] == "newmtl":
            materials[" ".join(words[1:])] = latest = {}
        elif words and materials and (len(words) > 1 or words[0] == "Kd"):
            latest[words[0]] = number, words[1:]
    return dict(materials)


def color_texture(path: Path, statements: Statements, images: DecodedImages) -> Image:
    """The texture (H, W, 3) of a material: ``map_Kd``, else the plain colour ``Kd``."""
    if "map_Kd" in statements:
        image = _image(path, statements["map_Kd"][1], "the colour Kd is used", images)
        if image is not None:
            return image
    return plain_tile(_three(path, statements, "Kd", 0.8))


def reflectance(path: Path, name: str, statements: Statements, images: DecodedImages) -> Material | None:
    """Material besides its colour; None for a matt one. Warns about unsupported statements.

    Args:
        path: The material file.
        name: Name of the material.
        statements: Its statements.
        images: Images of the file that are decoded already.
    """
    ignored = [keyword for keyword in _UNSUPPORTED if keyword in statements]
    maps = [key for key in ("map_Kd", "map_d", "map_Ke", *_NORMAL_MAPS) if key in statements]
    ignored += [
        f"{word} of {key}" for key in maps for word in statements[key][1][:-1] if word in ("-s", "-o", "-t")
    ]
    for keyword in ignored:
        warn_about(path, f"material {name!r}: {keyword} is not supported and ignored")
    shiny = _one(path, statements, "illum", 2.0) >= 2
    gloss = _three(path, statements, "Ks", 0.0) * _SPECULAR if shiny else np.zeros(3)
    exponent = max(_one(path, statements, "Ns", 0.0), 0.0)
    # roughness with the same width of highlight as the Blinn-Phong exponent
    roughness = _one(path, statements, "Pr", (2 / (exponent + 2)) ** 0.25 if shiny else 1.0)
    metallic, emission = _one(path, statements, "Pm", 0.0), _three(path, statements, "Ke", 0.0)
    opacity = _one(path, statements, "d", 1 - _one(path, statements, "Tr", 0.0))
    normals, emissive, alpha = (
        _normals(path, statements, images),
        _map(path, statements, "map_Ke", images),
        _alpha(path, statements, images),
    )
    if emissive is not None and not emission.any():
        emission = np.ones(3)
    plain = not gloss.any() and metallic == 0 and opacity >= 1 and not emission.any()
    if plain and normals is None and alpha is None:
        return None
    red, green, blue = np.clip(gloss, 0, 1).tolist()
    emitted_red, emitted_green, emitted_blue = np.clip(emission, 0, 1e4).tolist()
    return Material(
        metallic=min(max(metallic, 0.0), 1.0),
        roughness=min(max(roughness, 0.0), 1.0),
        specular=(red, green, blue),
        normals=normals,
        emission=(emitted_red, emitted_green, emitted_blue),
        emissive_map=emissive,
        alpha="blend" if opacity < 1 else "opaque" if alpha is None else "mask",
        opacity=min(max(opacity, 0.0), 1.0),
        alpha_map=alpha,
    )


def numbers(rows: list[list[str]], lines: list[int], width: int, keyword: str, path: str) -> Array:
    """Convert rows of words to numbers.

    Args:
        rows: Words of N lines.
        lines: Line number of each row.
        width: Numbers in each row.
        keyword: Keyword of the lines, for messages.
        path: File, for messages.

    Returns:
        Finite numbers, (N, width).

    Raises:
        MeshError: A row is wrong; the error has its line.
    """
    try:
        values = np.array(rows, dtype=float)
    except ValueError:
        values = np.empty((0, width))
    if values.shape == (len(rows), width) and np.isfinite(values).all():
        return values
    for row, number in zip(rows, lines, strict=True):
        try:
            valid = len(row) == width and bool(np.isfinite([float(word) for word in row]).all())
        except ValueError:
            valid = False
        if not valid:
            raise MeshError(
                f"'{keyword}' needs {width} finite numbers, not {' '.join(row)[:40]!r}",
                path=path,
                line=number,
            )
    raise MeshError(f"'{keyword}' lines cannot be read", path=path)


def _three(path: Path, statements: Statements, keyword: str, default: float) -> Array:
    if keyword not in statements:
        return np.full(3, default)
    line, words = statements[keyword]
    return np.asarray(numbers([words[:3]], [line], 3, keyword, str(path))[0])


def _one(path: Path, statements: Statements, keyword: str, default: float) -> float:
    if keyword not in statements:
        return default
    line, words = statements[keyword]
    return float(numbers([words[-1:]], [line], 1, keyword, str(path))[0, 0])


def _normals(path: Path, statements: Statements, images: DecodedImages) -> Image | None:
    """Normal map of a material; a grey image is a height map and converted."""
    keyword = next((key for key in _NORMAL_MAPS if key in statements), None)
    image = None if keyword is None else _map(path, statements, keyword, images)
    if image is None or keyword is None:
        return None
    if np.ptp(image.reshape(-1, 3), axis=1).max() > 8:
        return image
    words = statements[keyword][1]
    strength = words[words.index("-bm") + 1] if "-bm" in words[:-1] else "1"
    return height_to_normal_map(
        image[..., 0], 4 * _one(path, {keyword: (statements[keyword][0], [strength])}, keyword, 1)
    )


def _alpha(path: Path, statements: Statements, images: DecodedImages) -> Image | None:
    """Opacity (H, W) of ``map_d``: its alpha channel, or grey values without one."""
    if "map_d" not in statements:
        return None
    words = statements["map_d"][1]
    image, file = _image(path, words, "the material is opaque", images), _file(path, words[-1])
    if image is None or file is None:
        return None
    alpha = images.alpha(file, lambda: _read(file))
    return image[..., 0] if alpha is None else alpha


def _map(path: Path, statements: Statements, keyword: str, images: DecodedImages) -> Image | None:
    return (
        None if keyword not in statements else _image(path, statements[keyword][1], "it is ignored", images)
    )


def _image(path: Path, words: list[str], fallback: str, images: DecodedImages) -> Image | None:
    """Image that a statement names after its options; None with a warning if the file is missing."""
    file = _file(path, words[-1])
    if file is None:
        warn_about(path, f"texture {words[-1][:60]!r} not found beside the file: {fallback}")
        return None
    try:
        return images.get(file, lambda: _read(file))
    except MeshError as error:
        raise MeshError(error.message, path=file) from None


def _read(file: Path) -> bytes:
    return read_bytes(file, MeshError, "texture", MAX_IMAGE_BYTES)


def _file(path: Path, name: str) -> Path | None:
    """Image in the folder of the material file or below; None if it is missing."""
    file = resolve_inside(path.parent, name.replace("\\", "/"))
    return file if file is not None and exists(file) else None
