"""The plugin of pytest, as users have it: in runs of their own, beside other tests, with and without ROS."""

from __future__ import annotations

import importlib.util
import os
import re
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT
from waiting import PATIENCE

#: A tracker that sends the truth back, with the names that the document uses.
TRACKER = """
from geometry_msgs.msg import Pose, PoseArray
from rclpy.node import Node
from sensor_msgs.msg import MultiDOFJointState

class Tracker(Node):
    def __init__(self, **options):
        super().__init__("tracker", **options)
        self.poses = self.create_publisher(PoseArray, "/tracker/poses", 10)
        self.create_subscription(MultiDOFJointState, "/humans/anna/joints", self.on_joints, 10)

    def on_joints(self, joints):
        head = joints.transforms[joints.joint_names.index("vt3_end")].translation
        pose = Pose()
        pose.position.x, pose.position.y, pose.position.z = head.x, head.y, head.z
        self.poses.publish(PoseArray(header=joints.header, poses=[pose]))
"""
#: Two tests that write which ROS domain and process they have.
DOMAINS = """
import os
import time
import pytest

@pytest.mark.parametrize("number", range(2))
def test_domain(humansim_domain, number, request):
    assert os.environ["ROS_DOMAIN_ID"] == str(humansim_domain)
    folder = request.config.rootpath / "domains"
    folder.mkdir(exist_ok=True)
    (folder / f"{number}").write_text(f"{humansim_domain} {os.getpid()}")
    while len(list(folder.iterdir())) < 2:  # so that the other worker has the other test
        time.sleep(0.02)
"""


@pytest.fixture
def users(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> pytest.Pytester:
    """A folder of a user; the plugin is loaded once, also where the package is installed with it."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), str(pytester.path)]))
    monkeypatch.setenv("PYTEST_ADDOPTS", "-p humansim_ros.testing --strict-markers -p no:cacheprovider")
    return pytester


def run(users: pytest.Pytester, *options: str) -> Any:
    """Run pytest in a process of its own."""
    return users.runpytest_subprocess(*options, timeout=PATIENCE)


def test_setup_names_the_plugin_as_the_module_is_called() -> None:
    """`-p` and `pytest_plugins` may name the plugin of an installed package once more."""
    entry = re.search(r'"pytest11": \["([\w.]+) = ([\w.]+)"\]', (ROOT / "setup.py").read_text())
    assert entry is not None
    assert entry[1] == entry[2] == "humansim_ros.testing"
    assert importlib.util.find_spec(entry[2]) is not None


def test_runs_that_do_not_use_the_fixtures_stay_as_they_are(users: pytest.Pytester) -> None:
    users.makepyfile(
        """
        import os, signal, sys, warnings

        def test_nothing_is_loaded_or_set():
            loaded = {name for name in sys.modules if name.startswith("humansim_ros")}
            assert loaded == {"humansim_ros", "humansim_ros.lazy", "humansim_ros.testing"}
            assert not {"numpy", "rclpy", "yaml", "cv2"} & set(sys.modules)
            assert not {"ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"} & set(os.environ)
            assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
        """
    )
    with pytest.MonkeyPatch.context() as patch:
        for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
            patch.delenv(name, raising=False)
        run(users, "-W", "error").assert_outcomes(passed=1)


def test_processes_of_xdist_have_domains_of_their_own(users: pytest.Pytester) -> None:
    pytest.importorskip("xdist")
    users.makepyfile(DOMAINS)
    run(users, "-n", "2").assert_outcomes(passed=2)
    found = [path.read_text().split() for path in (users.path / "domains").iterdir()]
    domains, processes = zip(*found, strict=True)
    assert len(set(processes)) == 2
    assert len(set(domains)) == 2


def test_without_ros_there_are_scenes_and_graphs_are_skipped_with_advice(users: pytest.Pytester) -> None:
    """A scene is a file, a mapping or a parameter; wrong markers are errors."""
    users.makeconftest("import sys\nsys.modules['rclpy'] = None")
    camera = "{eye: {size: [32, 24], position: [3, 0, 1], look_at: [0, 0, 1]}}"
    (users.path / "near.yaml").write_text(f"cameras: {camera}")
    users.makepyfile(
        """
        import pytest
        CAMERA = {"size": [32, 24], "position": [3, 0, 1], "look_at": [0, 0, 1]}

        def test_default(humansim_scene):
            assert list(humansim_scene.actors) == ["anna", "ben"]
            assert list(humansim_scene.cameras) == ["left", "right"]

        @pytest.mark.humansim_scene("near.yaml")
        def test_file(humansim_scene):
            assert list(humansim_scene.cameras) == ["eye"]

        SCENES = ["near.yaml", {"cameras": {"other": CAMERA}}]

        @pytest.mark.parametrize("humansim_scene", SCENES, indirect=True)
        def test_parameter(humansim_scene):
            assert list(humansim_scene.cameras) in (["eye"], ["other"])

        @pytest.mark.humansim_scene("nobody.yaml")
        def test_missing(humansim_scene): pass

        @pytest.mark.humansim_scene("near.yaml", 3)
        def test_wrong(humansim_scene): pass

        @pytest.mark.humansim_graph(speed=1)
        def test_wrong_option(humansim_graph): pass

        def test_tracker(humansim_graph): pass
        """
    )
    result = run(users, "-rs")
    result.assert_outcomes(passed=4, errors=3, skipped=1)
    result.stdout.fnmatch_lines(
        [
            "*nobody.yaml*",
            "*UsageError: the marker humansim_scene has one argument*",
            "*UsageError: the marker humansim_graph has the options*",
            "*ROS 2 cannot be imported*pip install 'humansim_ros?ros?'*",
        ]
    )


def test_the_tests_of_the_document_work_as_printed(users: pytest.Pytester) -> None:
    """With a context of rclpy that a fixture of the user has initialised, and without."""
    pytest.importorskip("rclpy")
    text = (ROOT / "docs" / "testing.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    (test,) = (block for block in blocks if block.startswith("# test_tracker.py"))
    (ros,) = (block for block in blocks if "rclpy.init()" in block)
    (users.path / "my_tracker.py").write_text(TRACKER)
    (users.path / "test_tracker.py").write_text(test)
    own = users.mkdir("own")
    (own / "test_own.py").write_text(test)
    (own / "conftest.py").write_text(f"import pytest, rclpy\n{ros}")
    run(users).assert_outcomes(passed=2)


@pytest.mark.slow
@pytest.mark.nightly
def test_the_nodes_may_run_as_processes(tmp_path: Path, humansim_domain: int) -> None:
    from humansim_ros.data.messages import to_nanoseconds
    from humansim_ros.errors import RosError
    from humansim_ros.scene import Scene
    from humansim_ros.testing import SceneGraph
    from humansim_ros.testing.graph import NodeProcesses

    path = tmp_path / "scene.yaml"
    path.write_text("cameras: {eye: {size: [32, 24], position: [3, 0, 1], look_at: [0, 0, 1]}}\nrate: 20")
    with SceneGraph(Scene.load(path), namespace="lab", processes=True) as graph:
        images = graph.collect("eye/image_raw", 3)
        assert isinstance(graph._running, NodeProcesses)
        process = graph._running._process
        process.terminate()
        process.wait()
        with pytest.raises(RosError, match="humansim run has ended with exit code"):
            graph.play()
    stamps = [to_nanoseconds(each.header.stamp) for each in images]
    assert stamps == [1, 50_000_001, 100_000_001]
