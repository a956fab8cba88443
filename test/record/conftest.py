"""A local Ray for the tests of recordings."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def workers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A Ray with three workers; yields the folder for temporary files of the workers."""
    ray = pytest.importorskip("ray")
    folder = tmp_path_factory.mktemp("workers")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", f"{ROOT}{os.pathsep}{Path(__file__).parent}")
        patch.setenv("RAY_TMPDIR", "/tmp")  # its sockets must have short names
        patch.setenv("TMPDIR", str(folder))
        patch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        options = {"object_store_memory": 80 * 2**20, "include_dashboard": False}
        ray.init(num_cpus=3, log_to_driver=False, logging_level="error", **options)
    yield folder
    ray.shutdown()
