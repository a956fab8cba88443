"""Fixtures for tests of trackers with pytest (docs/testing.md).

    def test_tracker(humansim_graph):
        humansim_graph.add_node(Tracker())
        poses = humansim_graph.collect("/tracker/poses", 10)

Importing this module loads neither ROS nor NumPy, since pytest imports it in every run.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from humansim_ros.scene.core import Scene
    from humansim_ros.testing.graph import SceneGraph as SceneGraph

__all__ = ["SceneGraph"]

#: Scene of the fixtures: two people and two small cameras.
_SCENE = "config/scenes/testing.yaml"


def __getattr__(name: str) -> Any:
    if name == "SceneGraph":
        from humansim_ros.testing.graph import SceneGraph

        return SceneGraph
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def pytest_configure(config: pytest.Config) -> None:
    """Register the markers of the fixtures with pytest."""
    for line in (
        "humansim_scene(scene): scene of the fixture humansim_scene: a file, a mapping or a Scene",
        "humansim_graph(namespace, processes, limit): options of the fixture humansim_graph",
    ):
        config.addinivalue_line("markers", line)


@pytest.fixture(scope="session")
def humansim_domain() -> Iterator[int]:
    """Fixture: a ROS domain that no other test process on this machine uses. Until the end of the session,
    ROS_DOMAIN_ID is set to this domain, and other hosts do not see its nodes."""
    from humansim_ros.ros.graph import claim_domain, domain_environment
    from humansim_ros.testing.support import environment

    domain = claim_domain()
    with environment(**domain_environment(domain)):
        yield domain


@pytest.fixture
def humansim_scene(request: pytest.FixtureRequest) -> Scene:
    """Fixture: the scene of the test. The default has two people and two small cameras. The marker
    ``humansim_scene`` or an indirect parameter names another scene: a file relative to the file of the test,
    a mapping with the keys of a scene file, or a Scene."""
    from humansim_ros.files.reading import resource_path

    marker = request.node.get_closest_marker("humansim_scene")
    if hasattr(request, "param"):
        return _load(request.param, request.path.parent)
    if marker is None:
        return _load(resource_path(_SCENE), request.path.parent)
    if len(marker.args) != 1 or marker.kwargs:
        raise pytest.UsageError("the marker humansim_scene has one argument: a file, a mapping or a Scene")
    return _load(marker.args[0], request.path.parent)


@pytest.fixture
def humansim_graph(
    request: pytest.FixtureRequest, humansim_domain: int, humansim_scene: Any
) -> Iterator[SceneGraph]:
    """Fixture: nodes of ``humansim_scene`` in lockstep, in their own ROS domain (docs/testing.md). The marker
    ``humansim_graph`` takes the options of :class:`SceneGraph`. If ROS 2 is missing, the test is skipped."""
    from humansim_ros.errors import RosError
    from humansim_ros.ros.processes import require_ros

    marker = request.node.get_closest_marker("humansim_graph")
    options: Mapping[str, Any] = marker.kwargs if marker else {}
    unknown = options.keys() - {"namespace", "processes", "limit"}
    if unknown or (marker and marker.args):
        raise pytest.UsageError("the marker humansim_graph has the options namespace, processes and limit")
    try:
        require_ros()
    except RosError as reason:
        pytest.skip(str(reason))
    from humansim_ros.testing.graph import SceneGraph

    with SceneGraph(_load(humansim_scene, request.path.parent), **options) as graph:
        yield graph


def _load(scene: Any, folder: Path) -> Scene:
    """Load a scene from a file or a mapping. A Scene is returned unchanged. ``folder``: folder for relative
    files."""
    from humansim_ros.scene.core import Scene

    if isinstance(scene, (str, os.PathLike)):
        return Scene.load(folder / scene)
    return Scene.from_dict(scene, folder) if isinstance(scene, Mapping) else scene
