"""The environment of ``make demo`` in a fresh checkout: extras, ``ros2 run`` and ``ros2 launch``, and tf."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest
from conftest import ROOT
from test_packaging import EXECUTABLES, clean_environment
from waiting import PATIENCE

pytestmark = [pytest.mark.nightly, pytest.mark.slow]

#: What ament_index_python and ros2pkg do for ros2 run and ros2 launch.
AMENT = """
import json, os
from ament_index_python import get_package_prefix, get_package_share_directory, get_packages_with_prefixes
folder = os.path.join(get_package_prefix("humansim_ros"), "lib", "humansim_ros")
found = [os.path.join(folder, name) for name in os.listdir(folder)]
print(json.dumps({
    "listed": "humansim_ros" in get_packages_with_prefixes(),
    "share": get_package_share_directory("humansim_ros"),
    "executables": [path for path in found if os.access(path, os.X_OK)],
}))
"""
SCENE = """
rate: 20
room: null
humans: {anna: {body: child, motion: walk}}
cameras:
  fixed: {size: [64, 48], position: [3, 0.4, 1.4], look_at: [0, 0, 1]}
  moving: {size: [64, 48], trajectory: way.txt}
"""
WAY = "0 0 3 1.4 0 0 0 1\n10 1 3 1.4 0 0 0 1\n"
#: Prints the frames that each topic of tf had, and what lies behind a transform that only tf has.
TF = """
import json, os, subprocess, sys, time
import rclpy
from contextlib import closing
from geometry_msgs.msg import TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo
from tf2_msgs.msg import TFMessage
from humansim_ros.view.sources.ros_source import RosViewSource
from humansim_ros.view.sources.source import FrameRequest

rclpy.init()
node = rclpy.create_node("listener")
latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
seen = {"/tf": {}, "/tf_static": {}}
for topic, qos in (("/tf", 100), ("/tf_static", latched)):
    def take(message, topic=topic):
        for each in message.transforms:
            place = each.transform.translation
            seen[topic][each.child_frame_id] = [each.header.frame_id, place.x, place.y, place.z]
    node.create_subscription(TFMessage, topic, take, qos)
command = [sys.executable, "-m", "humansim_ros", "run", "scene.yaml", "--lockstep", "--frames", "300"]
with subprocess.Popen(command) as run:
    while run.poll() is None:
        rclpy.spin_once(node, timeout_sec=0.1)
    seen["exit code"] = run.returncode

static = node.create_publisher(TFMessage, "/tf_static", latched)
info = node.create_publisher(CameraInfo, "/eye/camera_info", latched)
transform = TransformStamped(child_frame_id="eye_optical")
transform.header.frame_id = "map"
transform.transform.translation.x, transform.transform.translation.z = 1.5, 2.0
transform.transform.rotation.w = 1.0
static.publish(TFMessage(transforms=[transform]))
message = CameraInfo(width=64, height=48, k=[50.0, 0.0, 32.0, 0.0, 50.0, 24.0, 0.0, 0.0, 1.0])
message.header.frame_id = "eye_optical"
info.publish(message)
with closing(RosViewSource(patience=20.0)) as source:
    for _ in range(100):
        message.header.stamp = node.get_clock().now().to_msg()
        info.publish(message)
        frame = source.frame(FrameRequest(0, ["eye"], ()))
        if "eye" in frame.cameras:
            seen["eye"] = frame.cameras["eye"].center.tolist()
            break
        time.sleep(0.1)
print(json.dumps(seen), flush=True)
os._exit(0)
"""


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the committed and changed files, with the environment of ``make demo``."""
    folder = tmp_path_factory.mktemp("fresh") / "humansim_ros"
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", "-z"], cwd=ROOT, capture_output=True
    )
    if listed.returncode:
        pytest.skip("needs a checkout of git")
    for name in filter(None, listed.stdout.decode().split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes((ROOT / name).read_bytes())
            (folder / name).chmod((ROOT / name).stat().st_mode)
    done = make("env", folder)
    if "No matching distribution found" in done.stderr:
        pytest.skip("needs a package index")
    assert done.returncode == 0, done.stderr
    (folder / "scene.yaml").write_text(SCENE)
    (folder / "way.txt").write_text(WAY)
    return folder


def make(target: str, folder: Path) -> subprocess.CompletedProcess[str]:
    environment = clean_environment() | {"XDG_CACHE_HOME": str(folder / "cache")}
    for name in ("VENV", "PYTHON", "VIRTUAL_ENV", "MAKEFLAGS"):
        environment.pop(name, None)
    return subprocess.run(
        ["make", target], cwd=folder, env=environment, capture_output=True, text=True, timeout=30 * PATIENCE
    )


def in_environment(checkout: Path, *command: object, **variables: str) -> str:
    """Output of a command in the environment of a checkout, as in a new terminal."""
    place = checkout / ".venv"
    path = f"{place / 'bin'}:{os.environ['PATH']}"
    done = subprocess.run(
        [str(word) for word in command],
        cwd=checkout,
        env=clean_environment(VIRTUAL_ENV=str(place), PATH=path, **variables),
        capture_output=True,
        text=True,
        timeout=10 * PATIENCE,
    )
    assert done.returncode == 0, f"{command}: {done.stdout}\n{done.stderr}"
    return done.stdout


def test_ros2_run_and_launch_find_the_editable_install(checkout: Path) -> None:
    place = checkout / ".venv"
    found = json.loads(in_environment(checkout, "python", "-c", AMENT, AMENT_PREFIX_PATH=str(place)))
    assert found["listed"] and Path(found["share"]) == place / "share" / "humansim_ros"
    assert (place / "share" / "humansim_ros" / "package.xml").is_file()
    assert (place / "share" / "humansim_ros" / "launch" / "demo.launch.py").is_file()
    assert {Path(path).name for path in found["executables"]} == EXECUTABLES
    for path in found["executables"]:
        name = Path(path).name
        of_nodes = () if name == "humansim" else ("--ros-args", "-p", "scene:=none.yaml")
        assert f" {name} " in in_environment(checkout, path, "--help", *of_nodes)
    root = "from humansim_ros.files.reading.assets import resource_root; print(resource_root())"
    assert Path(in_environment(checkout, "python", "-c", root).strip()) == checkout


def test_the_commands_of_the_readme_have_their_packages(checkout: Path) -> None:
    (checkout / "fixed.yaml").write_text(SCENE.partition("  moving:")[0])  # OpenPose has no moving cameras
    command = "humansim export fixed.yaml --frames 2 -o data --format coco,openpose,c3d,glb"
    in_environment(checkout, *command.split())
    assert json.loads((checkout / "data" / "index.json").read_text())["finished"]
    (checkout / "test_own.py").write_text("def test_it(humansim_domain): assert humansim_domain\n")
    assert "1 passed" in in_environment(checkout, "pytest", "test_own.py", "--noconftest")


def test_cameras_publish_tf_after_make_tf2_msgs_and_the_page_reads_it(checkout: Path) -> None:
    if "apt install" in (done := make("tf2_msgs", checkout)).stderr:
        pytest.skip(done.stderr.strip())
    assert done.returncode == 0, done.stderr
    limits = {"ROS_DOMAIN_ID": str(90 + os.getpid() % 10), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    seen = json.loads(in_environment(checkout, "python", "-c", TF, **limits).splitlines()[-1])
    assert seen["exit code"] == 0
    frame, *place = seen["/tf_static"]["fixed_optical_frame"]
    assert frame == "map" and place == pytest.approx([3, 0.4, 1.4])
    frame, x, *others = seen["/tf"]["moving_optical_frame"]
    assert frame == "map" and x > 0 and others == pytest.approx([3, 1.4])
    assert seen["eye"] == pytest.approx([1.5, 0, 2])
    doctor = json.loads(in_environment(checkout, "humansim", "doctor", "--json", **limits))
    assert next(each for each in doctor if each["name"] == "tf")["text"].startswith("tf2_msgs, ")
