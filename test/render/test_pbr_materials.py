"""Materials of world meshes, glTF and MTL: compared with the formulas of glTF 2.0 (appendix B)."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from figures import glb
from numpy.typing import NDArray
from render_scenes import quad, renderer_or_skip

from humansim_ros.cameras import Camera
from humansim_ros.errors import HumansimWarning, MeshError
from humansim_ros.files.mesh.load import read_materials_z_up
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.render import Lighting, View
from humansim_ros.render.device.pixel_geometry import ImageBackdrop

Array = NDArray[np.floating]
BLACK = (0.0, 0.0, 0.0)
#: A camera before the tiles below, which face it, -y; it sees x to the right.
EYE = (0.0, -3.0, 0.0)
CAMERA = Camera.look_at(EYE, (0, 0, 0), (160, 120), 0.6)
SQUARE = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], "<f4")
SUN = np.array([0.4, -0.8, 0.3])


def png(image: NDArray[np.uint8]) -> bytes:
    order = [2, 1, 0, 3][: image.shape[2]]
    return bytes(cv2.imencode(".png", image[..., order])[1].tobytes())


def plain(*color: int) -> bytes:
    return png(np.full((4, 4, len(color)), color, np.uint8))


def tile(
    folder: Path, material: dict[str, Any], *images: bytes, uv: bool = True, colors: Array | None = None
) -> list[Mesh]:
    """A square of a .glb file, 2 m wide, that faces -y of map; texture n is of image n."""
    accessors = {"POSITION": SQUARE}
    if uv:
        accessors["TEXCOORD_0"] = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], "<f4")
    if colors is not None:
        accessors["COLOR_0"] = np.tile(colors, (4, 1)).astype("<f4")
    blob, views, listed = b"", [], []
    kinds = {2: "VEC2", 3: "VEC3", 4: "VEC4"}
    parts = [array.tobytes() for array in accessors.values()]
    for part in [*parts, np.array([0, 1, 2, 0, 2, 3], "<u4").tobytes(), *images]:
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(part)})
        blob += part + b"\0" * (-len(part) % 4)
    for n, array in enumerate(accessors.values()):
        listed.append({"bufferView": n, "componentType": 5126, "count": 4, "type": kinds[array.shape[1]]})
    n = len(listed)
    listed.append({"bufferView": n, "componentType": 5125, "count": 6, "type": "SCALAR"})
    document = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {name: k for k, name in enumerate(accessors)},
                        "indices": n,
                        "material": 0,
                    }
                ]
            }
        ],
        "materials": [{"name": "tin", **material}],
        "textures": [{"source": k} for k in range(len(images))],
        "images": [{"bufferView": n + 1 + k, "mimeType": "image/png"} for k in range(len(images))],
        "accessors": listed,
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob)}],
    }
    (folder / "tile.glb").write_bytes(glb(document, blob))
    return read_materials_z_up(folder / "tile.glb", None)


def view(meshes: list[Mesh], light: Lighting, camera: Camera = CAMERA, backdrop: Any = None) -> View:
    renderer = renderer_or_skip(meshes, light)
    seen = renderer.render([], camera, ("rgb", "depth"), backdrop=backdrop)
    renderer.close()
    return seen


def linear(seen: View, x: float = 0.0, z: float = 0.0) -> Array:
    """(3,) light of the point (x, 0, z)."""
    column, row = CAMERA.project([(x, 0.0, z)])[0][0].round().astype(int)
    assert seen.rgb is not None
    return (seen.rgb[row, column] / 255.0) ** 2


def sun_alone(**more: Any) -> Lighting:
    return Lighting(
        sun=tuple(SUN),  # type: ignore[arg-type]
        sun_color=(0.5, 0.4, 0.3),
        sky_color=BLACK,
        ground_color=BLACK,
        shadows="none",
        sun_size_deg=0.01,
        **more,
    )


def brdf(base: Array, metallic: float, roughness: float, n: Array, point: Array, f0: float = 0.04) -> Array:
    """(3,) reflected sunlight by glTF 2.0, B.3; times pi: the unit is the radiance of a white surface."""
    v = np.array(EYE) - point
    v, sun, n = (x / np.linalg.norm(x) for x in (v, SUN, n))
    h = (v + sun) / np.linalg.norm(v + sun)
    a = roughness**2
    nl, nv, nh, vh = n @ sun, n @ v, n @ h, v @ h
    d = a**2 / (np.pi * (nh**2 * (a**2 - 1) + 1) ** 2)
    g = 2 * nl / (nl + np.sqrt(a**2 + (1 - a**2) * nl**2))
    g *= 2 * nv / (nv + np.sqrt(a**2 + (1 - a**2) * nv**2))
    specular = d * g / (4 * nl * nv)
    schlick = (1 - vh) ** 5
    dielectric_f = f0 + (1 - f0) * schlick
    dielectric = (1 - dielectric_f) * base / np.pi + dielectric_f * specular
    metal = specular * (base + (1 - base) * schlick)
    mixed = (1 - metallic) * dielectric + metallic * metal
    return np.asarray(np.pi * mixed * nl * np.array([0.5, 0.4, 0.3]))


def srgb_of(linear_light: Array) -> Array:
    return np.where(
        linear_light <= 0.0031308, 12.92 * linear_light, 1.055 * linear_light ** (1 / 2.4) - 0.055
    )


@pytest.mark.daily("False-1-0.5", "True-1-0.5")
@pytest.mark.slow
@pytest.mark.parametrize(("metallic", "roughness"), [(0, 1), (0, 0.4), (0.5, 0.6), (1, 0.5), (1, 1)])
@pytest.mark.parametrize("by_texture", [False, True])
def test_the_sun_comes_back_as_gltf_says(
    tmp_path: Path, metallic: float, roughness: float, by_texture: bool
) -> None:
    base = np.array([0.7, 0.5, 0.3])
    pbr: dict[str, Any] = {"baseColorFactor": [*base, 1]}
    images = []
    if by_texture:  # red, which means something else, must not matter
        images = [plain(9, round(255 * roughness), round(255 * metallic))]
        pbr["metallicRoughnessTexture"] = {"index": 0}
    else:
        pbr |= {"metallicFactor": metallic, "roughnessFactor": roughness}
    seen = view(tile(tmp_path, {"pbrMetallicRoughness": pbr}, *images), sun_alone())
    for x, z in ((0.0, 0.0), (-0.5, 0.3), (0.6, -0.4)):
        # colours are kept as sRGB, whose curve a square stands for
        expected = brdf(srgb_of(base) ** 2, metallic, roughness, np.array([0, -1.0, 0]), np.array([x, 0, z]))
        np.testing.assert_allclose(np.sqrt(linear(seen, x, z)), np.sqrt(np.minimum(expected, 1)), atol=0.012)


def test_factor_texture_and_vertex_colours_are_multiplied(tmp_path: Path) -> None:
    factor, vertex = np.array([0.8, 0.5, 0.9]), np.array([0.6, 0.9, 0.4])
    texture = np.array([200, 120, 240])
    material = {"pbrMetallicRoughness": {"baseColorFactor": [*factor, 1], "baseColorTexture": {"index": 0}}}
    meshes = tile(tmp_path, material, plain(*texture), colors=vertex)
    seen = np.sqrt(linear(view(meshes, Lighting(mode="shadeless"))))
    decoded = ((texture / 255 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(seen, srgb_of(decoded * factor * vertex), atol=0.02)


@pytest.mark.parametrize("tilt", [(0.5, 0.0), (0.0, 0.5), (-0.3, -0.4)])
def test_a_normal_map_tilts_to_the_right_and_up_of_its_image(
    tmp_path: Path, tilt: tuple[float, float]
) -> None:
    right, up = tilt
    out = np.sqrt(1 - right**2 - up**2)
    code = np.rint(127.5 * (np.array([right, up, out]) + 1)).astype(int)
    material = {
        "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 0.7},
        "normalTexture": {"index": 0},
    }
    seen = view(tile(tmp_path, material, plain(*code.tolist())), sun_alone())
    expected = brdf(np.ones(3), 0, 0.7, np.array([right, -out, up]), np.zeros(3))
    np.testing.assert_allclose(np.sqrt(linear(seen)), np.sqrt(np.minimum(expected, 1)), atol=0.012)


def test_emission_is_added_whatever_the_light(tmp_path: Path) -> None:
    material = {
        "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1], "metallicFactor": 0},
        "emissiveFactor": [0.5, 1, 0.2],
        "emissiveTexture": {"index": 0},
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 0.5}},
    }
    dark = Lighting(sun_color=BLACK, sky_color=BLACK, ground_color=BLACK)
    glow = np.array([255, 128, 64])
    seen = linear(view(tile(tmp_path, material, plain(*glow)), dark))
    np.testing.assert_allclose(seen, 0.5 * np.array([0.5, 1, 0.2]) * (glow / 255) ** 2, atol=0.01)


def half_cut(left: int, right: int) -> bytes:
    """A white image whose alpha differs left and right."""
    image = np.full((16, 16, 4), 255, np.uint8)
    image[:, :8, 3], image[:, 8:, 3] = left, right
    return png(image)


EVEN = Lighting(
    sun_color=BLACK, sky_color=(0.25,) * 3, ground_color=(0.25,) * 3, shadows="none", background=(90, 60, 30)
)


@pytest.mark.daily("soft-*")
@pytest.mark.slow
@pytest.mark.parametrize("backdrop", [False, True])
@pytest.mark.parametrize("shadows", ["none", "soft"])
def test_alpha_masks_and_blends(tmp_path: Path, backdrop: bool, shadows: str) -> None:
    light = Lighting(**{**EVEN.__dict__, "shadows": shadows})
    photo = ImageBackdrop(np.full((30, 40, 3), (90, 60, 30), np.uint8)) if backdrop else None
    pbr = {"baseColorFactor": [1, 1, 1, 0.8], "baseColorTexture": {"index": 0}, "metallicFactor": 0}
    shown = {}
    for mode in ("OPAQUE", "MASK", "BLEND"):
        material = {"pbrMetallicRoughness": pbr, "alphaMode": mode, "alphaCutoff": 0.6}
        shown[mode] = view(tile(tmp_path, material, half_cut(128, 255)), light, backdrop=photo)
    solid = np.sqrt(linear(shown["OPAQUE"], 0.5))
    behind = np.array([90, 60, 30]) / 255
    for x, mask, alpha in ((-0.5, 0, 128 / 255 * 0.8), (0.5, 1, 0.8)):
        column, row = CAMERA.project([(x, 0.0, 0.0)])[0][0].round().astype(int)
        assert np.sqrt(linear(shown["OPAQUE"], x)) == pytest.approx(solid, abs=0.01)
        assert np.sqrt(linear(shown["MASK"], x)) == pytest.approx(solid if mask else behind, abs=0.01)
        blended = alpha * solid + (1 - alpha) * behind
        assert np.sqrt(linear(shown["BLEND"], x)) == pytest.approx(blended, abs=0.012)
        depths = [float(shown[mode].depth[row, column]) for mode in ("OPAQUE", "MASK", "BLEND")]
        assert depths == pytest.approx([3, 3 if mask else np.inf, np.inf], abs=1e-4)


def test_of_panes_behind_each_other_the_nearest_is_in_front_of_all(tmp_path: Path) -> None:
    panes = []
    for color, y in (((1, 0, 0), 0.0), ((0, 1, 0), 0.6)):
        pbr = {"baseColorFactor": [*BLACK, 0.5], "metallicFactor": 0, "roughnessFactor": 1}
        (mesh,) = tile(tmp_path, {"pbrMetallicRoughness": pbr, "alphaMode": "BLEND", "emissiveFactor": color})
        panes.append(replace(mesh, vertices=mesh.vertices + np.array([0, y, 0])))
    dark = Lighting(sun_color=BLACK, sky_color=BLACK, ground_color=BLACK, background=(0, 0, 0))
    for order in (panes, panes[::-1]):
        red, green, _ = np.sqrt(linear(view(order, dark)))
        assert (red, green) == pytest.approx((0.5, 0.25), abs=0.01)


def test_one_sided_surfaces_are_seen_from_their_front_alone(tmp_path: Path) -> None:
    behind = Camera.look_at((0, 3, 0), (0, 0, 0), (160, 120), 0.6)
    for both in (False, True):
        mesh = tile(tmp_path, {"doubleSided": both})
        assert np.isfinite(view(mesh, EVEN).depth[60, 80])
        assert np.isfinite(view(mesh, EVEN, behind).depth[60, 80]) == both


def test_what_is_cut_out_casts_no_shadow(tmp_path: Path) -> None:
    material = {
        "alphaMode": "MASK",
        "doubleSided": True,
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}},
    }
    (mesh,) = tile(tmp_path, material, half_cut(0, 255))
    back = quad([(-3, 1, -3), (3, 1, -3), (3, 1, 3), (-3, 1, 3)])
    light = Lighting(sun=(0, -1, 0.01), sky_color=BLACK, ground_color=BLACK, shadows="soft", sun_size_deg=0.5)
    above = Camera.look_at((0, 0.4, 2.5), (0, 1, -0.2), (160, 120), 0.9)
    seen = view([mesh, back], light, above)
    for x, lit in ((-0.5, True), (0.5, False)):
        column, row = above.project([(x, 1.0, -0.2)])[0][0].round().astype(int)
        assert (seen.rgb[row, column].max() > 100) == lit


@pytest.mark.daily("1-1")
@pytest.mark.slow
@pytest.mark.parametrize(("metallic", "roughness"), [(0, 0.2), (0, 1), (1, 0.1), (1, 0.6), (1, 1)])
def test_in_even_light_nothing_sends_back_more_than_falls_on_it(
    tmp_path: Path, metallic: float, roughness: float
) -> None:
    pbr = {"metallicFactor": metallic, "roughnessFactor": roughness}
    meshes = tile(tmp_path, {"pbrMetallicRoughness": pbr})
    for place in (EYE, (2.0, -1.5, 0.5), (2.5, -0.5, 0.2)):
        camera = Camera.look_at(place, (0, 0, 0), (160, 120), 0.3)
        shown = (view(meshes, EVEN, camera).rgb[60, 80] / 255.0) ** 2
        assert (0.4 if metallic else 0.85) * 0.25 < shown.min() and shown.max() < 0.25 * 1.03


TILE_OBJ = """\
mtllib tile.mtl
v -1 0 -1
v 1 0 -1
v 1 0 1
v -1 0 1
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl tin
f 1/1 2/2 3/3 4/4
"""


def obj_tile(folder: Path, material: str, obj: str = TILE_OBJ) -> list[Mesh]:
    (folder / "tile.obj").write_text(obj)
    (folder / "tile.mtl").write_text(f"newmtl tin\n{material}\n")
    return read_materials_z_up(folder / "tile.obj", None)


def test_shininess_of_an_mtl_is_a_rough_surface_as_glossy(tmp_path: Path) -> None:
    seen = view(obj_tile(tmp_path, "Kd 0.6 0.6 0.6\nKs 0.5 0.5 0.5\nNs 38"), sun_alone())
    expected = brdf(np.full(3, 0.36), 0, (2 / 40) ** 0.25, np.array([0, -1.0, 0]), np.zeros(3))
    np.testing.assert_allclose(np.sqrt(linear(seen)), np.sqrt(expected), atol=0.012)
    own = view(obj_tile(tmp_path, "Kd 0.6 0.6 0.6\nKs 0.5 0.5 0.5\nNs 38\nPr 0.9\nPm 1"), sun_alone())
    expected = brdf(np.full(3, 0.36), 1, 0.9, np.array([0, -1.0, 0]), np.zeros(3))
    np.testing.assert_allclose(np.sqrt(linear(own)), np.sqrt(expected), atol=0.012)
    (matt,) = obj_tile(tmp_path, "Kd 0.6 0.6 0.6\nKs 0.5 0.5 0.5\nNs 38\nillum 1")
    assert matt.material is None


def test_an_mtl_blends_cuts_out_and_shines_by_itself(tmp_path: Path) -> None:
    (tmp_path / "cut.png").write_bytes(half_cut(0, 255))
    for material in ("d 0.3", "Tr 0.7"):
        seen = np.sqrt(linear(view(obj_tile(tmp_path, f"Kd 1 1 1\n{material}"), EVEN)))
        np.testing.assert_allclose(seen, 0.3 * 0.5 + 0.7 * np.array([90, 60, 30]) / 255, atol=0.012)
    depth = view(obj_tile(tmp_path, "Kd 1 1 1\nmap_d cut.png"), EVEN).depth
    assert np.isinf(depth[60, 60]) and np.isfinite(depth[60, 100])
    glowing = view(obj_tile(tmp_path, "Kd 0 0 0\nKe 0.2 0.4 0.1"), EVEN)
    np.testing.assert_allclose(linear(glowing), (0.2, 0.4, 0.1), atol=0.01)


def test_a_grey_bump_map_is_of_heights_and_a_blue_one_of_normals(tmp_path: Path) -> None:
    # heights that rise to the right turn the normal to the left
    (tmp_path / "rise.png").write_bytes(
        png(np.tile(np.arange(0, 256, 4, np.uint8)[None, :, None], (64, 1, 3)))
    )
    (tmp_path / "tilt.png").write_bytes(plain(64, 128, 238))
    bare = linear(view(obj_tile(tmp_path, "Kd 0.8 0.8 0.8"), sun_alone()))
    for name in ("map_Bump -bm 8 rise.png", "norm tilt.png"):
        assert (linear(view(obj_tile(tmp_path, f"Kd 0.8 0.8 0.8\n{name}"), sun_alone())) < 0.9 * bare).all()


# --- wrong and unsupported content


@pytest.mark.parametrize(
    ("material", "uv", "words"),
    [
        (
            {"normalTexture": {"index": 0}},
            False,
            "the normal map, because the mesh has no texture coordinates",
        ),
        ({"occlusionTexture": {"index": 0}}, True, "the ambient occlusion map"),
        ({"extensions": {"KHR_materials_transmission": {}}}, True, "extension 'KHR_materials_transmission'"),
        (
            {
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}},
                "normalTexture": {"index": 0, "texCoord": 1},
            },
            True,
            "the normal map, because the colour has other texture coordinates",
        ),
    ],
)
def test_each_unsupported_part_of_a_material_gives_one_warning(
    tmp_path: Path, material: dict[str, Any], uv: bool, words: str
) -> None:
    with pytest.warns(HumansimWarning, match=rf"tile\.glb: material 'tin': ignored: {words}") as told:
        tile(tmp_path, material, plain(1, 2, 255), uv=uv)
    assert len(told) == 1


def test_unsupported_parts_of_an_mtl_give_warnings(tmp_path: Path) -> None:
    (tmp_path / "tilt.png").write_bytes(plain(64, 128, 238))
    without = TILE_OBJ.replace("f 1/1 2/2 3/3 4/4", "f 1 2 3 4")
    for material, obj, words in (
        ("map_Ks a.png", TILE_OBJ, "map_Ks is not supported and ignored"),
        ("norm tilt.png", without, "the normal map is ignored: the mesh has no texture coordinates"),
        ("norm gone.png", TILE_OBJ, "'gone.png' not found beside the file"),
        ("map_Kd -s 2 2 2 tilt.png", TILE_OBJ, "-s of map_Kd is not supported and ignored"),
    ):
        with pytest.warns(HumansimWarning, match=words):
            obj_tile(tmp_path, material, obj)


@pytest.mark.parametrize(
    "material",
    [
        {"normalTexture": {"index": 0}},
        {"emissiveTexture": {"index": 0}},
        {"pbrMetallicRoughness": {"metallicRoughnessTexture": {"index": 0}}},
        {"normalTexture": {"index": 7}},
        {"alphaMode": "HALF"},
    ],
)
def test_a_texture_that_cannot_be_read_is_told_with_its_file(
    tmp_path: Path, material: dict[str, Any]
) -> None:
    with pytest.raises(MeshError) as caught:
        tile(tmp_path, material, plain(1, 2, 3)[:40])
    assert caught.value.path == str(tmp_path / "tile.glb") and caught.value.key


@pytest.mark.parametrize(
    ("material", "words"),
    [("map_Bump cut.png", "cut.png"), ("Ns many", "Ns"), ("d", "tin|d"), ("Ke 1 2", "Ke")],
)
def test_a_wrong_mtl_is_told_with_its_file(tmp_path: Path, material: str, words: str) -> None:
    (tmp_path / "cut.png").write_bytes(plain(1, 2, 3)[:40])
    if material == "d":  # says nothing, as some programs write it
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert obj_tile(tmp_path, material)[0].material is None
        return
    with pytest.raises(MeshError, match=words):
        obj_tile(tmp_path, material)
