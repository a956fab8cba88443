"""Environments of scenes: meshes with materials, photographs, panoramas, random looks; and their errors.

Panoramas are checked by their headers, and reduced before all of their light is in memory.
"""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from figures import glb
from numpy.typing import NDArray
from render_scenes import renderer_or_skip

from humansim_ros.errors import HumansimError, HumansimWarning, MeshError, SceneError
from humansim_ros.render import Lighting
from humansim_ros.render.device.pixel_geometry import ImageBackdrop, Panorama, ambient
from humansim_ros.render.interface.lighting import tone_mapped
from humansim_ros.scene import Scene, Simulation
from humansim_ros.scene.core import environment
from humansim_ros.scene.core.environment import load_panorama

EYE = "cameras:\n  eye: {size: [160, 120], position: [0, 0, 1], look_at: [3, 0, 1], fov_deg: 60}\n"
PLAIN = "room: null\nlight: {mode: shadeless}\n"
RED, BLUE = (200, 30, 30), (30, 30, 200)


def load(folder: Path, text: str) -> Scene:
    (folder / "scene.yaml").write_text(EYE + text)
    return Scene.load(folder / "scene.yaml")


def picture(scene: Scene) -> NDArray[np.uint8]:
    renderer = renderer_or_skip(scene.static_meshes, scene.environment.lighting)
    camera = scene.scene_cameras["eye"]
    rgb = renderer.render([], camera.camera, ("rgb",), backdrop=camera.backdrop).rgb
    renderer.close()
    return rgb


def two_tiles() -> bytes:
    """A .glb with y up: a red square left of the origin and a textured one right of it, facing +z."""
    square = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], "<f4")
    uv = np.array([(0, 2), (2, 2), (2, 0), (0, 0)], "<f4")  # the texture is there four times
    corners = np.array([0, 1, 2, 0, 2, 3], "<u2")
    stripes = np.zeros((16, 16, 3), np.uint8)
    stripes[:8], stripes[8:] = BLUE, (220, 220, 60)
    image = cv2.imencode(".png", stripes[..., ::-1])[1].tobytes()
    parts = [
        (square - np.float32([1, 0, 0])).tobytes(),
        square.tobytes(),
        uv.tobytes(),
        corners.tobytes(),
        image,
    ]
    views, blob = [], b""
    for part in parts:
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(part)})
        blob += part + b"\0" * (-len(part) % 4)
    linear = [((c / 255 + 0.055) / 1.055) ** 2.4 for c in RED]
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {"attributes": {"POSITION": 0}, "indices": 3, "material": 0},
                    {"attributes": {"POSITION": 1, "TEXCOORD_0": 2}, "indices": 3, "material": 1},
                ]
            }
        ],
        "materials": [
            {"pbrMetallicRoughness": {"baseColorFactor": [*linear, 1]}},
            {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}},
        ],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 4, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 2, "componentType": 5126, "count": 4, "type": "VEC2"},
            {"bufferView": 3, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob)}],
    }
    return glb(json.loads(json.dumps(document)), blob)


# z up: the same two squares in the plane y = 0
TWO_TILES_OBJ = """\
mtllib tiles.mtl
v -1 0 0
v 0 0 0
v 0 0 1
v -1 0 1
v 1 0 0
v 1 0 1
vt 0 0
vt 2 0
vt 2 2
vt 0 2
usemtl plain
f 1 2 3 4
usemtl striped
f 2/1 5/2 6/3 3/4
"""


@pytest.mark.parametrize("kind", ["glb", "obj"])
def test_mesh_files_have_their_position_and_their_materials(tmp_path: Path, kind: str) -> None:
    (tmp_path / "tiles.glb").write_bytes(two_tiles())
    (tmp_path / "tiles.obj").write_text(TWO_TILES_OBJ)
    (tmp_path / "tiles.mtl").write_text(
        f"newmtl plain\nKd {RED[0] / 255} {RED[1] / 255} {RED[2] / 255}\nnewmtl striped\nmap_Kd s.png\n"
    )
    stripes = np.zeros((16, 16, 3), np.uint8)
    stripes[:8], stripes[8:] = BLUE, (220, 220, 60)
    cv2.imwrite(str(tmp_path / "s.png"), stripes[..., ::-1])
    # turned so that its front, -y, looks at the camera: red is on the left, seen from there
    place = f"{{file: tiles.{kind}, position: [3, 0, 0], rotation_deg: [0, 0, -90], scale: 1.5}}"
    scene = load(tmp_path, f"{PLAIN}world: {{meshes: [{place}], background: [1, 2, 3]}}")
    rgb, camera = picture(scene), scene.cameras["eye"]

    def at(y: float, z: float) -> list[int]:
        x, row = camera.project([(3.0, y, z)])[0][0].round().astype(int)
        return rgb[row, x].tolist()

    assert np.allclose(at(0.75, 0.75), RED, atol=1)
    # from below: yellow, blue, and again
    for z, color in ((0.19, (220, 220, 60)), (0.56, BLUE), (0.94, (220, 220, 60)), (1.31, BLUE)):
        np.testing.assert_allclose(at(-0.75, z), color, atol=1)
    assert at(0.75, 1.7) == [1, 2, 3]


def test_an_object_keeps_its_texture_without_a_colour(tmp_path: Path) -> None:
    (tmp_path / "tiles.glb").write_bytes(two_tiles())
    text = PLAIN + "objects:\n  tiles: {mesh: tiles.glb, position: [3, 0, 0.5], rotation_deg: [0, 0, -90]%s}"
    seen = {extra: picture(load(tmp_path, text % extra)) for extra in ("", ", color: [0, 255, 0]")}
    colors = np.unique(seen[""].reshape(-1, 3), axis=0).astype(int)
    assert any(np.abs(colors - RED).max(1) <= 2) and any(np.abs(colors - BLUE).max(1) <= 2)
    assert (seen[", color: [0, 255, 0]"][40:80, 60:100, [0, 2]] == 0).all()


def test_a_photograph_covers_what_is_endlessly_far_away(tmp_path: Path) -> None:
    photo = np.random.default_rng(1).integers(0, 255, (30, 60, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "photo.png"), photo[..., ::-1])
    (tmp_path / "tiles.glb").write_bytes(two_tiles())
    text = EYE.replace("fov_deg: 60}", "fov_deg: 60, background: photo.png}") + PLAIN
    (tmp_path / "scene.yaml").write_text(text + "world: {meshes: [{file: tiles.glb, position: [3, 1, 0]}]}")
    scene = Scene.load(tmp_path / "scene.yaml")
    simulation = Simulation(scene, ("rgb", "depth"))
    view = simulation.frame(0).views["eye"]
    simulation.close()
    # as high as the image, its middle two thirds
    expected = cv2.resize(photo[:, 10:50], (160, 120), interpolation=cv2.INTER_LINEAR)
    empty = cv2.erode(np.isinf(view.depth).astype(np.uint8), np.ones((3, 3))) > 0
    assert 0.5 < empty.mean() < 1
    np.testing.assert_array_equal(view.rgb[empty], expected[empty])
    small = ImageBackdrop(photo).picture(scene.cameras["eye"])
    assert small.shape == (120, 160, 3)


@pytest.mark.parametrize("lens", ["", ", distortion: [-0.2, 0.05]"])
def test_a_panorama_is_seen_by_direction(tmp_path: Path, lens: str) -> None:
    # red grows to the left of +x, green upwards; blue is one
    left = np.pi - 2 * np.pi * (np.arange(720) + 0.5) / 720
    up = np.pi / 2 - np.pi * (np.arange(360) + 0.5) / 360
    pano = np.ones((360, 720, 3), np.float32)
    pano[..., 0], pano[..., 1] = 0.5 + left / 8, 0.5 + up[:, None] / 4
    cv2.imwrite(str(tmp_path / "pano.hdr"), pano[..., ::-1])
    text = EYE.replace("fov_deg: 60}", f"fov_deg: 60{lens}}}").replace(
        "look_at: [3, 0, 1]", "look_at: [3, 1, 2]"
    )
    (tmp_path / "scene.yaml").write_text(
        text + "room: null\nworld: {environment: pano.hdr, environment_yaw_deg: 20}"
    )
    scene = Scene.load(tmp_path / "scene.yaml")
    rgb, camera = picture(scene), scene.cameras["eye"]
    rows, columns = np.mgrid[:120:7, :160:7].reshape(2, -1)
    ray = camera.unproject(np.stack([columns, rows], 1), np.ones(len(rows))) - camera.center
    to_left = np.arctan2(ray[:, 1], ray[:, 0]) - np.radians(20)
    to_up = np.arctan2(ray[:, 2], np.hypot(ray[:, 0], ray[:, 1]))
    light = np.stack([0.5 + to_left / 8, 0.5 + to_up / 4, np.ones(len(rows))], 1)
    np.testing.assert_allclose(rgb[rows, columns], 255 * np.sqrt(light), atol=2.5)
    # its light is the mean, weighted by the sine of the elevation
    steep = np.cos(up) * np.sin(up)
    sky = ((0.5 + up / 4) * steep)[up > 0].sum() / steep[up > 0].sum()
    assert scene.environment.lighting.sky_color == pytest.approx((0.5, sky, 1.0), abs=0.01)


def test_a_panorama_has_no_seam_behind_the_camera() -> None:
    radiance = np.full((64, 128, 3), 0.25, np.float32)
    scene = Scene.load()
    back = scene.cameras["camera_1"]  # it looks along -x
    picture = Panorama(tone_mapped(radiance, Lighting())).picture(back)
    assert (picture == 128).all()
    assert ambient(radiance) == (pytest.approx((0.25,) * 3), pytest.approx((0.25,) * 3))


# --- drawn at random

RANDOM = """\
humans:
  a: {motion: {file: walk, position: [0.0, -1.59]}}
  b: {motion: {file: wave, position: [1, 1]}}
light: {shadows: soft}
randomise: {seed: %d, light: true, colours: true, textures: true, clutter: 8,
  camera_jitter: {position: 0.1, rotation_deg: 4}}
"""


@pytest.mark.nightly
@pytest.mark.slow
def test_the_same_seed_draws_the_same_and_another_another(tmp_path: Path) -> None:
    first, again, other = (load(tmp_path, RANDOM % seed) for seed in (3, 3, 4))
    assert first.environment.lighting == again.environment.lighting != other.environment.lighting
    assert first.environment.lighting.shadows == "soft"
    for a, b, c in zip(first.static_meshes, again.static_meshes, other.static_meshes, strict=False):
        np.testing.assert_array_equal(a.vertices, b.vertices)
        for x, y in ((a.texture, b.texture), (a.colors, b.colors)):
            assert (x is None and y is None) or np.array_equal(x, y)
        assert a.texture is None or c.texture is None or not np.array_equal(a.texture, c.texture)
    assert np.array_equal(first.cameras["eye"].P, again.cameras["eye"].P)
    assert not np.array_equal(first.cameras["eye"].P, other.cameras["eye"].P)
    # each kind by itself
    alone = load(
        tmp_path, (RANDOM % 3).replace("light: true", "light: false").replace("clutter: 8", "clutter: 3")
    )
    assert np.array_equal(alone.cameras["eye"].P, first.cameras["eye"].P)
    assert [alone.objects[n].initial_pose.position.tolist() for n in alone.objects] == [
        first.objects[n].initial_pose.position.tolist() for n in list(first.objects)[:3]
    ]


def test_cameras_are_moved_and_turned_no_farther_than_asked(tmp_path: Path) -> None:
    scene, plain = load(tmp_path, RANDOM % 9), load(tmp_path, "")
    there, here = scene.cameras["eye"], plain.cameras["eye"]
    shift = np.abs(there.center - here.center)
    assert 0 < shift.max() <= 0.1 + 1e-9
    angle = np.degrees(np.arccos((np.trace(there.R @ here.R.T) - 1) / 2))
    assert 0 < angle <= 4 * np.sqrt(3)
    np.testing.assert_array_equal(there.K, here.K)


@pytest.mark.daily("1")
@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_clutter_is_on_the_floor_away_from_all_obstacles(tmp_path: Path, seed: int) -> None:
    scene = load(tmp_path, RANDOM % seed)
    things = [scene.objects[f"clutter_{n}"] for n in range(1, 9)]
    people = np.concatenate(
        [actor.at(t).vertices[:, :2] for actor in scene.actors.values() for t in np.arange(0, 12, 0.5)]
    )
    for thing in things:
        corners = thing.static_mesh().vertices
        assert corners[:, 2].min() == pytest.approx(0, abs=1e-3)
        centre = thing.initial_pose.position[:2]
        reach = np.linalg.norm(corners[:, :2] - centre, axis=1).max()
        assert np.linalg.norm(people - centre, axis=1).min() > reach
        assert (np.abs(corners[:, :2]).max(0) < (3.5, 3.2)).all()
        assert np.linalg.norm(scene.cameras["eye"].center[:2] - centre) > reach
    # nor in the furniture
    room = np.concatenate([mesh.vertices for mesh in scene.environment.meshes])
    standing = room[(room[:, 2] > 0.2) & (room[:, 2] < 1.5)][:, :2]
    for thing in things:
        radius = min(thing.initial_pose.size[:2]) / 2
        assert np.linalg.norm(standing - thing.initial_pose.position[:2], axis=1).min() > radius


@pytest.mark.nightly
@pytest.mark.slow
def test_clutter_without_a_position_is_reported(tmp_path: Path) -> None:
    with pytest.warns(
        HumansimWarning, match=r"scene\.yaml:3: randomise\.clutter: only \d+ of 150 objects find a position"
    ):
        scene = load(tmp_path, "randomise: {clutter: 150}")
    assert 5 < len(scene.objects) < 150


# --- wrong input

BAD = {
    "gone.jpg": None,
    "text.jpg": b"this is a letter",
    "cut.png": cv2.imencode(".png", np.zeros((40, 40, 3), np.uint8))[1].tobytes()[:60],
    "text.hdr": b"#?RADIANCE\nand so on, but no picture",
    "large.hdr": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 90000 +X 180000\n",
    "cut.hdr": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 64 +X 128\n\1\2\3",
    "image.exr": b"\x76\x2f\x31\x01 and so on",
    "empty.jpg": b"",
    "broken.glb": two_tiles()[:300],
    "broken.obj": b"v 0 0 zero\nf 1 1 1\n",
    "square.png": cv2.imencode(".png", np.zeros((40, 40, 3), np.uint8))[1].tobytes(),
}


@pytest.mark.parametrize(
    ("text", "key", "words"),
    [
        ("world: {background: gone.jpg}", "world.background", "no such file .*gone.jpg"),
        ("world: {background: text.jpg}", "world.background", "text.jpg.*not a PNG or JPEG"),
        ("world: {background: cut.png}", "world.background", "cut.png.*damaged"),
        ("world: {background: empty.jpg}", "world.background", "empty"),
        ("world: {background: .}", "world.background", "folder"),
        ("world: {background: [1, 2, 300]}", "world.background", "255"),
        ("world: {environment: text.hdr}", "world.environment", "text.hdr.*no panorama"),
        ("world: {environment: large.hdr}", "world.environment", "too large"),
        ("world: {environment: cut.hdr}", "world.environment", "cut.hdr.*damaged"),
        ("world: {environment: image.exr}", "world.environment", r"image.exr.*(pip install OpenEXR|damaged)"),
        ("world: {environment: square.png}", "world.environment", "twice as wide"),
        ("world: {meshes: [gone.glb]}", "world.meshes.0.file", "no such file"),
        ("world: {meshes: [{file: a.obj, scale: 0}]}", "world.meshes.0.scale", "number above 0"),
        ("randomise: {clutter: -1}", "randomise.clutter", "from 0 to 1000"),
        ("randomise: {camera_jitter: {position: -1}}", "randomise.camera_jitter.position", "from 0 to 100"),
        ("randomise: {light: bright}", "randomise.light", "true or false"),
        ("light: {sun: [0, 0, 0]}", "light", "direction"),
        ("light: {strength: -1}", "light.strength", "from 0 to 10000"),
        (
            "light: {shadow: soft}",
            "light.shadow",
            "unknown key; did you mean `shadows`. Known here: mode, sun",
        ),
        ("light: {sun_size_deg: 0}", "light.sun_size_deg", "above 0"),
    ],
)
def test_a_wrong_world_is_refused_with_file_and_key(tmp_path: Path, text: str, key: str, words: str) -> None:
    _write_bad(tmp_path)
    with pytest.raises(SceneError, match=words) as caught:
        load(tmp_path, text)
    assert caught.value.path == str(tmp_path / "scene.yaml")
    assert caught.value.line == 3
    assert caught.value.key is not None and caught.value.key.startswith(key)


@pytest.mark.parametrize("name", ["broken.glb", "broken.obj", "text.hdr"])
def test_a_wrong_mesh_is_refused_with_its_file(tmp_path: Path, name: str) -> None:
    _write_bad(tmp_path)
    with pytest.raises(MeshError) as caught:
        load(tmp_path, f"world: {{meshes: [{name}]}}")
    assert caught.value.path == str(tmp_path / "scene.yaml")
    assert (caught.value.line, caught.value.key) == (3, "world.meshes.0.file")
    cause = caught.value.__cause__
    assert isinstance(cause, MeshError)
    assert str(tmp_path / name) == cause.path
    assert caught.value.message == str(cause)


def test_a_texture_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\nf 1 2 3\n")
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd text.jpg\n")
    _write_bad(tmp_path)
    with pytest.raises(HumansimError, match=r"text\.jpg: .*not a PNG or JPEG"):
        load(tmp_path, "world: {meshes: [a.obj]}")


@pytest.mark.parametrize(("scale", "words"), [(1000, "2000 m large.*scale: 0.001"), (0.005, "10 mm large")])
def test_a_mesh_in_the_wrong_unit_is_reported(tmp_path: Path, scale: float, words: str) -> None:
    (tmp_path / "tiles.glb").write_bytes(two_tiles())
    with pytest.warns(HumansimWarning, match=words):
        load(tmp_path, f"world: {{meshes: [{{file: tiles.glb, scale: {scale}}}]}}")


def _write_bad(folder: Path) -> None:
    for name, content in BAD.items():
        if content is not None:
            (folder / name).write_bytes(content)


def test_an_openexr_panorama_is_that_of_the_same_light(tmp_path: Path) -> None:
    openexr = pytest.importorskip("OpenEXR", reason="pip install OpenEXR")
    light = np.random.default_rng(2).random((32, 64, 3)).astype(np.float32) * 3
    light[3, 5], light[4, 6, 1] = np.inf, np.nan
    with openexr.File({"compression": openexr.ZIP_COMPRESSION}, {"RGB": light}) as file:
        file.write(str(tmp_path / "sky.exr"))
    grey = {"type": openexr.scanlineimage}
    with openexr.File(grey, {"Y": np.ones((32, 64), np.float32)}) as file:
        file.write(str(tmp_path / "grey.exr"))
    read = load_panorama(tmp_path / "sky.exr")
    expected = np.where(np.isnan(light), 0, np.minimum(light, 65504))
    np.testing.assert_array_equal(read, expected)
    with pytest.raises(SceneError, match="no channel 'R'; there are Y"):
        load_panorama(tmp_path / "grey.exr")


def colours(height: int, width: int) -> NDArray[np.uint8]:
    """Random image (H, W, 3) with details of some pixels."""
    small = np.random.default_rng(3).integers(0, 256, (height // 8, width // 8, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_NEAREST))


def written(path: Path, image: NDArray[np.generic]) -> Path:
    """File with an RGB image."""
    assert cv2.imwrite(str(path), image[..., ::-1])
    return path


@pytest.fixture
def small_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Panoramas of more than 1000 columns are reduced: 600 rows in several strips."""
    monkeypatch.setattr(environment, "_MAX_WIDTH", 1000)


@pytest.mark.parametrize("suffix", [".png", ".hdr"])
@pytest.mark.usefixtures("small_limit")
def test_a_large_panorama_is_the_mean_of_the_light_of_its_pixels(suffix: str, tmp_path: Path) -> None:
    """Its mean light, not its mean colour: computed at once, in double precision."""
    image = colours(600, 1200)
    light = np.square(image / 255.0)
    path = written(tmp_path / f"large{suffix}", image if suffix == ".png" else light.astype(np.float32))
    if suffix == ".hdr":
        light = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1].astype(float)
    expected = cv2.resize(light, (1000, 500), interpolation=cv2.INTER_AREA)
    np.testing.assert_allclose(load_panorama(path), expected, atol=1e-6)


@pytest.mark.usefixtures("small_limit")
def test_an_openexr_panorama_is_reduced_too(tmp_path: Path) -> None:
    exr = pytest.importorskip("OpenEXR")
    light = colours(600, 1200).astype(np.float32)
    channels = {name: np.ascontiguousarray(light[..., n]) for n, name in enumerate("RGB")}
    with exr.File({"type": exr.scanlineimage}, channels) as file:
        file.write(str(tmp_path / "large.exr"))
    expected = cv2.resize(light, (1000, 500), interpolation=cv2.INTER_AREA)
    np.testing.assert_allclose(load_panorama(tmp_path / "large.exr"), expected, atol=1e-3)


def test_an_openexr_file_with_very_many_channels_is_not_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exr = pytest.importorskip("OpenEXR")
    channels = {f"c{number}": np.zeros((64, 128), np.float16) for number in range(40)}
    with exr.File({"type": exr.scanlineimage}, channels) as file:
        file.write(str(tmp_path / "many.exr"))
    with pytest.raises(SceneError, match="no channel 'R'"):
        load_panorama(tmp_path / "many.exr")
    monkeypatch.setattr(environment, "_MAX_VALUES", 39 * 64 * 128)
    with pytest.raises(SceneError, match="40 channels of 128 x 64 pixels are too many"):
        load_panorama(tmp_path / "many.exr")


@pytest.mark.parametrize("suffix", [".png", ".hdr"])
def test_a_panorama_of_another_shape_is_refused_by_its_header(suffix: str, tmp_path: Path) -> None:
    """Before 8192 x 8192 pixels are decoded from a few bytes."""
    written(tmp_path / f"small{suffix}", np.zeros((4, 4, 3), np.uint8 if suffix == ".png" else np.float32))
    data = (tmp_path / f"small{suffix}").read_bytes()
    side = b"8192" if suffix == ".hdr" else (8192).to_bytes(4, "big")
    data = data.replace(b"-Y 4 +X 4", b"-Y %s +X %s" % (side, side)).replace(2 * b"\0\0\0\4", 2 * side)
    (tmp_path / f"square{suffix}").write_bytes(data)
    tracemalloc.start()
    with pytest.raises(SceneError, match="twice as wide as high, this one is 8192 x 8192"):
        load_panorama(tmp_path / f"square{suffix}")
    used = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert used < 1 << 20


@pytest.mark.nightly
@pytest.mark.slow
def test_memory_for_a_panorama_is_little_more_than_its_bytes(tmp_path: Path) -> None:
    """8192 x 4096 bytes of three channels, twice, and the result; all light at once would be 400 MB more."""
    path = written(tmp_path / "wide.png", np.zeros((4096, 8192, 3), np.uint8))
    tracemalloc.start()
    panorama = load_panorama(path)
    used = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert panorama.shape == (2048, 4096, 3)
    assert used < 2 * 8192 * 4096 * 3 + 3 * panorama.nbytes + 0.1e9
