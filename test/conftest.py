"""Where the tests find what they read: this repository's own files, and real files that others wrote."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: Real motions, meshes and calibrations, beside the repository unless HUMANSIM_SHARED_DATA says where.
SHARED_DATA = Path(os.environ.get("HUMANSIM_SHARED_DATA") or ROOT.parent / "shared" / "data")

needs_shared_data = pytest.mark.skipif(
    not SHARED_DATA.is_dir(), reason=f"no shared files at {SHARED_DATA} (HUMANSIM_SHARED_DATA)"
)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real files; the test is skipped where it is absent."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"no shared files at {SHARED_DATA} (HUMANSIM_SHARED_DATA)")
    return SHARED_DATA


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Humans that tests make are not kept among the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HUMANSIM_CACHE", str(tmp_path_factory.mktemp("humans")))
        yield


@pytest.fixture(scope="session")
def assets() -> Path:
    """The bodies and motions that come with the package."""
    return ROOT / "assets"


@pytest.fixture(scope="module")
def ros() -> Iterator[None]:
    """rclpy, with room for images, for the tests of one file."""
    import rclpy

    from humansim_ros.ros.runtime import prepare_transport

    prepare_transport()
    rclpy.init()
    yield
    rclpy.try_shutdown()
