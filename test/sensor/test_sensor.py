"""The sensor, measured from its images like a real sensor."""

from __future__ import annotations

import re
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from conftest import ROOT
from keyframe_text import keyframes
from numpy.typing import NDArray
from pydantic import ValidationError
from render_scenes import renderer_or_skip
from scipy.integrate import quad

from humansim_ros.cameras import Camera, ChromaticAberration, Noise, Sensor, SensorConfig, Vignetting
from humansim_ros.errors import CameraError
from humansim_ros.geometry import moved
from humansim_ros.render import View
from humansim_ros.scene import Scene, Simulation

Picture = NDArray[np.uint8]

SIZE = (320, 240)
#: Skewed, not square, off centre.
K = np.array([[300.0, 2.0, 150.0], [0.0, 290.0, 130.0], [0.0, 0.0, 1.0]])
CAMERA = Camera(SIZE, K, np.eye(3), np.zeros(3))
EVERY_LEVEL = np.resize(np.arange(256, dtype=np.uint8), (*SIZE[::-1], 3))
#: Linear light of integer sRGB values.
LIGHT = {value: (value / 255 + 0.055) ** 2.4 / 1.055**2.4 for value in (60, 90, 128, 160, 188, 220, 255)}


def flat(
    red: int, green: int | None = None, blue: int | None = None, size: tuple[int, int] = SIZE
) -> Picture:
    """An image of one colour."""
    green, blue = red if green is None else green, red if blue is None else blue
    return np.broadcast_to(np.array([red, green, blue], np.uint8), (size[1], size[0], 3)).copy()


def shown(
    picture: Picture, stamp: int = 1, camera: Camera = CAMERA, name: str = "", **config: Any
) -> Picture:
    """Image of a sensor for a static scene."""
    sensor = Sensor(SensorConfig(**config), camera, name)
    return sensor.expose([picture] * len(sensor.times()), stamp)


def bar(left: float, width: float = 40.0) -> Picture:
    """A white bar from ``left`` on; its edges are anti-aliased in linear light."""
    x = np.arange(SIZE[0])
    share = np.clip(x + 0.5 - left, 0, 1) * np.clip(left + width - x + 0.5, 0, 1)
    light = np.where(share <= 0.0031308, 12.92 * share, 1.055 * share ** (1 / 2.4) - 0.055)
    return flat(0) + np.rint(255 * light).astype(np.uint8)[None, :, None]


def middle(row: NDArray[Any]) -> float:
    """Centroid of the light of a row."""
    return float((row * np.arange(len(row))).sum() / row.sum())


# --- no effects


def test_without_effects_the_image_is_unchanged() -> None:
    sensor = Sensor(SensorConfig(), CAMERA)
    assert not sensor.active
    assert sensor.times().tolist() == [0.0]
    assert sensor.expose([EVERY_LEVEL], 5) is EVERY_LEVEL


@pytest.mark.parametrize(
    "config",
    [
        {"exposure_time": 0.01},
        {"rolling_shutter": 1e-5},
        {"rolling_shutter": 1e-5, "exposure_time": 0.003, "samples": 5},
        {"vignetting": {}},
        {"chromatic_aberration": {}},
        {"exposure": 0.25, "gain_db": 20 * np.log10(4)},
    ],
)
def test_shutter_effects_keep_all_values_of_a_static_scene(config: dict[str, Any]) -> None:
    """Conversion to light and back keeps all 256 levels."""
    np.testing.assert_array_equal(shown(EVERY_LEVEL, **config), EVERY_LEVEL)


@pytest.mark.parametrize("response", ["srgb", "linear", 2.2])
@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8", "bayer_rggb8"])
def test_white_stays_white_and_black_black(response: Any, encoding: Any) -> None:
    config = {"response": response, "encoding": encoding, "exposure_time": 0.01}
    assert (shown(flat(255), **config) == 255).all()
    assert (shown(flat(0), **config) == 0).all()


# --- response


def test_responses_agree_with_their_formulas() -> None:
    light = np.where(
        np.arange(256) <= 10, np.arange(256) / 255 / 12.92, ((np.arange(256) / 255 + 0.055) / 1.055) ** 2.4
    )
    picture = EVERY_LEVEL
    np.testing.assert_allclose(shown(picture, response="linear"), 255 * light[picture], atol=0.51)
    np.testing.assert_allclose(shown(picture, response=1.8), 255 * light[picture] ** (1 / 1.8), atol=1)
    twice = np.minimum(1, 2 * light[picture])
    np.testing.assert_allclose(shown(picture, response="linear", exposure=2.0), 255 * twice, atol=0.51)
    np.testing.assert_allclose(
        shown(picture, response="linear", gain_db=20 * np.log10(2)), 255 * twice, atol=0.51
    )


def test_white_balance_and_black_level_are_linear_in_light() -> None:
    out = shown(flat(188), response="linear", white_balance=(1.2, 1.0, 0.7), black_level=8)
    np.testing.assert_allclose(out[0, 0], 8 + 255 * LIGHT[188] * np.array([1.2, 1.0, 0.7]), atol=0.51)


# --- noise: photon transfer (EMVA 1288)


def test_the_photon_transfer_curve_recovers_gain_and_read_noise() -> None:
    """Variance is linear in the mean, with the slope of the gain; without light it is the read noise."""
    well, read, gain = 2000.0, 9.0, 10 ** (6 / 20)
    config = {
        "noise": {"full_well": well, "read_noise": read},
        "response": "linear",
        "gain_db": 6.0,
        "black_level": 20,
        "exposure": 0.5,
    }
    means, variances = [], []
    for value in (0, *[v for v in LIGHT if v < 250]):
        first, second = (shown(flat(value), stamp, **config).astype(float) for stamp in (1, 2))
        means.append((first.mean() + second.mean()) / 2 - 20)
        variances.append((first - second).var() / 2 - 1 / 12)  # rounding has a variance of 1/12
    slope = np.polyfit(means, variances, 1)[0]
    assert slope == pytest.approx(255 * gain / well, rel=0.02)
    assert np.sqrt(variances[0]) / slope == pytest.approx(read, rel=0.02)
    expected = [255 * gain * 0.5 * light for value, light in LIGHT.items() if value < 250]
    np.testing.assert_allclose(means[1:], expected, atol=0.06)


def test_few_photons_are_poisson_distributed() -> None:
    """Without read noise, at one electron per level, values have a Poisson distribution."""
    config = {"noise": {"full_well": 255, "read_noise": 0}, "response": "linear", "exposure": 0.02}
    counts = shown(flat(188), **config)
    mean = 0.02 * 255 * LIGHT[188]
    expected = np.exp(-mean) * np.cumprod([1, *(mean / np.arange(1, 8))])
    shares = np.bincount(counts.ravel(), minlength=8)[:8] / counts.size
    np.testing.assert_allclose(shares, expected, atol=4 * np.sqrt(expected.max() / counts.size))


def test_dark_current_adds_electrons_with_time_and_their_shot_noise() -> None:
    config = {"noise": {"full_well": 2550, "read_noise": 0, "dark_current": 2e4}, "response": "linear"}
    out = shown(flat(0), exposure_time=0.05, **config).astype(float)
    assert out.mean() == pytest.approx(1000 / 10, abs=0.05)
    assert out.var() == pytest.approx(1000 / 100 + 1 / 12, rel=0.02)


def test_saturated_pixels_have_no_noise_and_the_value_of_their_gain() -> None:
    assert (shown(flat(255), exposure=2.0, noise={}) == 255).all()
    for noise in (None, {}):
        out = shown(flat(255), exposure=2.0, noise=noise, white_balance=(0.5, 1, 1), response="linear")
        assert (out == [128, 255, 255]).all()


def test_noise_depends_on_seed_camera_and_stamp_only() -> None:
    picture, noise = flat(128), {"noise": {"read_noise": 30.0}}
    one = shown(picture, 7, name="left", **noise)
    np.testing.assert_array_equal(one, shown(picture, 7, name="left", **noise))
    others = [
        shown(picture, 8, name="left", **noise),
        shown(picture, 7, name="right", **noise),
        shown(picture, 7, name="left", seed=1, **noise),
    ]
    for other in others:
        together = np.corrcoef(one.ravel().astype(float), other.ravel().astype(float))[0, 1]
        assert abs(together) < 4 / np.sqrt(one.size)


def test_noise_does_not_repeat_within_an_image() -> None:
    """The autocorrelation of the noise has one peak."""
    out = shown(flat(128), noise={"read_noise": 30.0}).ravel().astype(float)
    spectrum = np.abs(np.fft.rfft(out - out.mean())) ** 2
    together = np.fft.irfft(spectrum)[1:] / spectrum.sum() * out.size / 2
    assert np.abs(together).max() < 6 / np.sqrt(out.size)


# --- lens


@pytest.mark.parametrize(
    ("model", "distortion"),
    [(None, ()), ("plumb_bob", (-0.2, 0.05, 0.001, 0.0, 0.0)), ("equidistant", (0.01,))],
)
def test_natural_vignetting_is_the_fourth_power_of_the_cosine(model: Any, distortion: Any) -> None:
    """The angle to the optical axis is that by OpenCV."""
    camera = Camera(
        SIZE, np.array([[150.0, 0, 150], [0, 140, 130], [0, 0, 1]]), np.eye(3), np.zeros(3), distortion, model
    )
    out = shown(flat(255), camera=camera, response="linear", vignetting={"cos4": True})
    pixels = np.array([[0.0, 0], [319, 239], [150, 130], [40, 200], [300, 20]])
    if model == "equidistant":
        d = np.array([0.01, 0, 0, 0])
        rays = cv2.fisheye.undistortPoints(pixels[:, None], camera.K, d)[:, 0]
    else:
        rays = cv2.undistortPoints(pixels[:, None], camera.K, np.array([*distortion, *[0.0] * 5][:5]))[:, 0]
    angle = np.arctan(np.linalg.norm(rays, axis=1))
    column, row = pixels.astype(int).T
    np.testing.assert_allclose(out[row, column, 0], 255 * np.cos(angle) ** 4, atol=0.6)


def test_pixels_without_a_ray_get_no_light() -> None:
    camera = Camera(SIZE, K, np.eye(3), np.zeros(3), (-0.9,))
    out = shown(flat(255), camera=camera, vignetting={"cos4": True})
    assert (out[0, 0] == 0).all() and (out[130, 150] == 255).all()


def test_vignetting_removes_the_given_fraction_at_the_farthest_corner() -> None:
    half = shown(flat(255), response="linear", vignetting={"corner": 0.5})
    assert half[0, 319].tolist() == [128, 128, 128]  # farthest from (150, 130)
    assert half[130, 150].tolist() == [255, 255, 255]
    same = shown(flat(255), response="linear", vignetting={"polynomial": (-0.5, 0, 0)})
    np.testing.assert_array_equal(half, same)


def test_chromatic_aberration_shifts_edges_by_the_given_pixels() -> None:
    """The shift is that at the farthest corner, and proportional to the distance from the principal point."""
    reach = np.hypot(319 - 150, 130)
    aberration = {"red": 3.0, "blue": -2.0}
    for left in (40.0, 200.0, 260.0):
        out = shown(bar(left), response="linear", chromatic_aberration=aberration).astype(float)
        at = [middle(out[60, :, channel]) for channel in range(3)]
        assert at[0] - at[1] == pytest.approx(3.0 * (at[1] - 150) / reach, abs=0.05)
        assert at[2] - at[1] == pytest.approx(-2.0 * (at[1] - 150) / reach, abs=0.05)


# --- shutter


def test_a_global_shutter_blurs_a_moving_edge_over_its_displacement() -> None:
    speed, exposure = 3000.0, 0.01
    sensor = Sensor(SensorConfig(exposure_time=exposure, samples=60, response="linear"), CAMERA)
    pictures = [bar(100 + speed * time) for time in sensor.times()]
    row = sensor.expose(pictures, 1)[120, :, 0] / 255
    x = np.arange(SIZE[0])
    ramp = np.clip((x - 100) / (speed * exposure) + 0.5, 0, 1) * (x < 120)
    fall = np.clip((140 - x) / (speed * exposure) + 0.5, 0, 1) * (x >= 120)
    np.testing.assert_allclose(row, ramp + fall, atol=0.02)
    assert middle(row) == pytest.approx(120, abs=0.05)


@pytest.mark.parametrize("exposure", [0.0, 1e-12, 0.0011, 0.02])
def test_a_rolling_shutter_skews_by_speed_and_row_time(exposure: float) -> None:
    """Each row shows the bar at its own time, the middle row at the stamp."""
    speed, row_time = 2000.0, 5e-5
    config = SensorConfig(exposure_time=exposure, rolling_shutter=row_time, samples=25, response="linear")
    sensor = Sensor(config, CAMERA)
    pictures = [bar(130 + speed * time) for time in sensor.times()]
    out = sensor.expose(pictures, 1)[..., 1].astype(float)
    y = np.arange(SIZE[1])
    at = np.array([middle(row) for row in out])
    np.testing.assert_allclose(at, 150 + speed * row_time * (y - (SIZE[1] - 1) / 2), atol=0.1)


@pytest.mark.parametrize(
    ("exposure", "row_time", "samples"), [(0.01, 2e-5, 7), (0.0, 3e-5, 4), (0.001, 1e-4, 9)]
)
def test_each_row_collects_light_during_its_own_exposure(
    exposure: float, row_time: float, samples: int
) -> None:
    """Weights agree with light that is interpolated between samples and integrated by SciPy."""
    config = SensorConfig(exposure_time=exposure, rolling_shutter=row_time, samples=samples)
    sensor = Sensor(config, CAMERA)
    times, weights = sensor.times(), sensor.weights()
    assert weights.shape == (SIZE[1], samples)
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-12)
    light = np.random.default_rng(4).uniform(size=samples)
    for row in (0, 50, 120, 239):
        start = (row - (SIZE[1] - 1) / 2) * row_time - exposure / 2
        expected = np.interp(start, times, light)
        if exposure:
            inner = times[(times > start) & (times < start + exposure)]
            area, _ = quad(np.interp, start, start + exposure, (times, light), points=inner, limit=200)
            expected = area / exposure
        assert weights[row] @ light == pytest.approx(expected, abs=1e-9)


def test_blur_averages_light_not_srgb_values() -> None:
    """White and black for half of the exposure each is half of the light: 188, not 128."""
    sensor = Sensor(SensorConfig(exposure_time=0.01, samples=2), CAMERA)
    assert (sensor.expose([flat(0), flat(255)], 1) == 188).all()


@pytest.mark.parametrize("motion", ["walk", "sit_stand", "wave"])
def test_bodies_extrapolated_at_constant_velocity_agree_with_the_motion(motion: str, tmp_path: Path) -> None:
    """The error after 8 ms is a small fraction of the displacement."""
    config = {
        "humans": {"one": {"motion": {"file": motion}}},
        "cameras": {"camera": {"position": (3, 3, 2), "look_at": (0, 0, 1)}},
        "room": None,
    }
    actor = Scene.from_dict(config, tmp_path).actors["one"]
    errors, ways = [], []
    for seconds in np.arange(0.3, 1.5, 0.1):
        now, later = actor.at(seconds), actor.at(seconds + 0.008)
        assert now.linear is not None and now.angular is not None
        joints = moved(now.joints, now.linear, now.angular, 0.008)
        vertices = actor.human.pose(joints[: len(actor.human.skeleton)])
        errors.append(np.linalg.norm(vertices - later.vertices, axis=1))
        ways.append(np.linalg.norm(now.vertices - later.vertices, axis=1))
    assert np.mean(errors) < 0.0004
    assert np.mean(errors) < 0.1 * np.mean(ways)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, View]:
    """A bright board that moves at 2 m/s to the right, seen by three cameras with one pose."""
    folder = tmp_path_factory.mktemp("board")
    (folder / "moves.xml").write_text(keyframes(20, 10, board=((0, -2, 1), (0, 2, 1))))
    sensors: dict[str, Any] = {
        "ideal": {},
        "blurred": {"exposure_time": 0.1, "samples": 40},
        "rolling": {"rolling_shutter": 0.0005, "samples": 60},
    }
    camera = {"size": SIZE, "position": (4, 0, 1), "look_at": (0, 0, 1), "fov_deg": 50}
    config = {
        "rate": 10,
        "room": None,
        "objects": {"board": {"size": (0.02, 0.53, 1.6), "color": (250, 250, 250), "keyframes": "moves.xml"}},
        "cameras": {
            name: {**camera, "sensor": {"response": "linear", **sensor}} for name, sensor in sensors.items()
        },
    }
    scene = Scene.from_dict(config, folder)
    simulation = Simulation(scene, renderer=renderer_or_skip(scene.static_meshes))
    views = simulation.frame(10).views
    simulation.close()
    return views


def lit(view: View) -> NDArray[np.float64]:
    """Fraction (H, W) of the light of each pixel that comes from the board."""
    light = view.rgb[..., 0].astype(float)
    light = light - light[:, :1]
    return light / light[120].max()


#: Speed of the board in pixels per second; the cameras look along -x, so that it moves to the right.
SPEED = 2 * (SIZE[0] / 2 / np.tan(np.radians(25))) / 3.99


def test_a_captured_board_is_blurred_to_both_sides_of_its_depth(filmed: dict[str, View]) -> None:
    ideal, blurred = filmed["ideal"], filmed["blurred"]
    np.testing.assert_array_equal(blurred.depth, ideal.depth)
    row, depth = lit(blurred)[120], np.isfinite(ideal.depth[120])
    assert middle(row) == pytest.approx(middle(depth), abs=0.3)
    # the light rises while the edge of the board crosses a pixel; the rest of its area is fully lit
    assert row.sum() == pytest.approx(depth.sum(), abs=1)
    assert (row > 0.01).sum() - depth.sum() == pytest.approx(SPEED * 0.1, abs=2)


def test_a_captured_board_is_skewed_by_a_rolling_shutter(filmed: dict[str, View]) -> None:
    ideal, rolling = filmed["ideal"], filmed["rolling"]
    np.testing.assert_array_equal(rolling.depth, ideal.depth)
    straight = middle(np.isfinite(ideal.depth[120]))
    rows = np.arange(70, 170)
    at = np.array([middle(row) for row in lit(rolling)[rows]])
    np.testing.assert_allclose(at, straight + SPEED * 0.0005 * (rows - (SIZE[1] - 1) / 2), atol=0.3)


# --- encodings


def test_demosaicing_recovers_the_colours() -> None:
    """rggb of ROS is BG of OpenCV, which names the second and third pixel of the second row."""
    for colour in ((200, 30, 90), (10, 250, 60), (0, 0, 255)):
        raw = shown(flat(*colour), encoding="bayer_rggb8")
        assert raw.shape == SIZE[::-1]
        assert (raw[0, 0], raw[0, 1], raw[1, 0], raw[1, 1]) == (colour[0], colour[1], colour[1], colour[2])
        back = cv2.cvtColor(raw, cv2.COLOR_BayerBG2BGR)[..., ::-1]
        np.testing.assert_array_equal(back[2:-2, 2:-2], flat(*colour)[2:-2, 2:-2])


def test_bayer_pixels_get_the_gain_and_the_vignetting_of_their_colour() -> None:
    config = {"vignetting": {"corner": 0.5}, "white_balance": (1.5, 1.0, 0.8), "response": "linear"}
    colour = shown(flat(188), **config)
    raw = shown(flat(188), encoding="bayer_rggb8", **config)
    np.testing.assert_array_equal(raw[0::2, 0::2], colour[0::2, 0::2, 0])
    np.testing.assert_array_equal(raw[0::2, 1::2], colour[0::2, 1::2, 1])
    np.testing.assert_array_equal(raw[1::2, 1::2], colour[1::2, 1::2, 2])


def test_mono_is_the_luminance_of_light() -> None:
    out = shown(flat(255, 0, 0), encoding="mono8", response="linear")
    assert out.shape == SIZE[::-1]
    assert (out == round(255 * 0.2126)).all()
    assert (shown(flat(0, 0, 255), encoding="mono8", response="linear") == round(255 * 0.0722)).all()
    np.testing.assert_array_equal(
        shown(EVERY_LEVEL[..., :1].repeat(3, 2), encoding="mono8"), EVERY_LEVEL[..., 0]
    )


def test_bgr_is_rgb_in_reverse_order() -> None:
    for config in ({}, {"noise": {}}, {"jpeg": 60}):
        swapped = shown(EVERY_LEVEL, encoding="bgr8", **config)
        np.testing.assert_array_equal(swapped, shown(EVERY_LEVEL, **config)[..., ::-1])


@pytest.mark.parametrize("encoding", ["rgb8", "mono8"])
def test_jpeg_agrees_with_opencv(encoding: Any, tmp_path: Path) -> None:
    picture = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 256, (240, 320, 3), np.uint8), (0, 0), 3)
    out = shown(picture, encoding=encoding, jpeg=35)
    plain = shown(picture, encoding=encoding)
    file = str(tmp_path / "picture.jpg")
    cv2.imwrite(file, plain[..., ::-1] if plain.ndim == 3 else plain, [cv2.IMWRITE_JPEG_QUALITY, 35])
    expected = cv2.imread(file, cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(out, expected[..., ::-1] if plain.ndim == 3 else expected)


def test_images_of_odd_and_tiny_sizes_pass_all_effects() -> None:
    for size in ((1, 1), (3, 5), (2, 1)):
        camera = Camera(size, K, np.eye(3), np.zeros(3))
        for encoding in ("rgb8", "mono8", "bayer_rggb8"):
            config = {
                "encoding": encoding,
                "noise": {},
                "vignetting": {"cos4": True},
                "chromatic_aberration": {"red": 1.0},
                "exposure_time": 0.01,
                "rolling_shutter": 1e-5,
            }
            picture = flat(128, size=size)
            out = shown(picture, camera=camera, **config)
            assert out.shape == (picture.shape if encoding == "rgb8" else picture.shape[:2])
            assert (picture == 128).all()


# --- bad input


@pytest.mark.parametrize(
    ("key", "config"),
    [
        ("gain", {"gain": 2}),
        ("noise.full_well", {"noise": {"full_well": 0}}),
        ("noise.read_noise", {"noise": {"read_noise": float("nan")}}),
        ("noise", {"noise": {"dark_current": 10}}),
        ("exposure", {"exposure": -1}),
        ("exposure_time", {"exposure_time": float("inf")}),
        ("samples", {"samples": 10**9}),
        ("samples", {"samples": 1, "rolling_shutter": 1e-5}),
        ("response", {"response": "filmic"}),
        ("response", {"response": 0}),
        ("response", {"response": [2.2]}),
        ("white_balance", {"white_balance": (1, 1)}),
        ("white_balance", {"white_balance": (2, 1, 1), "encoding": "mono8"}),
        ("vignetting.polynomial", {"vignetting": {"polynomial": (-3, 0, 0)}}),
        ("chromatic_aberration.green", {"chromatic_aberration": {"green": 1}}),
        ("encoding", {"encoding": "yuv422"}),
        ("jpeg", {"jpeg": 0}),
        ("jpeg", {"jpeg": 90, "encoding": "bayer_rggb8"}),
        ("seed", {"seed": -1}),
    ],
)
def test_wrong_values_are_named_by_their_key(key: str, config: dict[str, Any]) -> None:
    with pytest.raises(ValidationError) as caught:
        SensorConfig.model_validate(config)
    assert ".".join(map(str, caught.value.errors()[0]["loc"])).startswith(key)


def test_every_key_and_its_default_are_documented() -> None:
    text = (ROOT / "docs" / "sensors.md").read_text()
    example = re.search(r"```yaml\n(.*?)```", text, re.DOTALL)
    assert example is not None
    assert Sensor(SensorConfig(**yaml.safe_load(example[1])["cameras"]["camera_1"]["sensor"]), CAMERA).active
    keys = text.split("\n## ")[1]
    for key, field in SensorConfig.model_fields.items():
        part = {"noise": Noise, "vignetting": Vignetting, "chromatic_aberration": ChromaticAberration}.get(
            key
        )
        for name in [key] if part is None else [f"{key}.{name}" for name in part.model_fields]:
            assert f"| `{name}`" in keys or f"`.{name.split('.')[-1]}`" in keys, name
        if isinstance(field.default, (int, float)):
            assert re.search(rf"\| `{key}` \| {field.default:g} \|", keys), key


def test_an_aberration_of_more_than_half_the_image_is_refused() -> None:
    config = SensorConfig(chromatic_aberration={"blue": -100})
    with pytest.raises(CameraError, match="100x80") as caught:
        Sensor(config, Camera((100, 80), K, np.eye(3), np.zeros(3)))
    assert caught.value.key == "sensor.chromatic_aberration"


def test_images_are_consumed_one_at_a_time() -> None:
    """Many samples of a large image need no more memory than few."""
    sensor = Sensor(SensorConfig(exposure_time=0.01, samples=9), CAMERA)
    alive: set[int] = set()

    def rendered() -> Iterator[Picture]:
        for number in range(9):
            picture = flat(number)
            alive.add(number)
            weakref.finalize(picture, alive.discard, number)
            yield picture
            del picture
            assert len(alive) <= 1

    assert sensor.expose(rendered(), 1).shape == (240, 320, 3)


def test_images_of_wrong_size_type_or_number_are_refused() -> None:
    sensor = Sensor(SensorConfig(exposure_time=0.01, samples=2), CAMERA)
    one = flat(1)
    for pictures in ([], [one], [one] * 3, [one, flat(1, size=(20, 20))], [one, one.astype(float)]):
        with pytest.raises(CameraError, match="the sensor needs"):
            sensor.expose(pictures, 1)
