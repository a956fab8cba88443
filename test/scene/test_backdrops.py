"""Panoramas are checked by their headers, and reduced before all of their light is in memory."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from humansim_ros.errors import SceneError
from humansim_ros.scene import environment
from humansim_ros.scene.environment import load_panorama


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
    with pytest.raises(SceneError, match="no channel R"):
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
