"""``humansim doctor``: check this machine, and print the command that mends each problem."""

from __future__ import annotations

import importlib.util
import json
import math
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import typer

from humansim_ros.cli.output import print_text, to_json
from humansim_ros.errors import HumansimError
from humansim_ros.files.reading import FBX_VARIABLE, find_converter
from humansim_ros.ros.graph import files_of_fast_dds, free_memory

#: Result of a check: usable, usable with a drawback, not usable.
State = Literal["ok", "warning", "wrong"]
#: Longest time of a check in a separate process, seconds.
_PATIENCE = 90.0
#: Exit code of a check that takes longer than this.
_TIMED_OUT = 124
_MB = 1 << 20
#: Least free shared memory (for the images of one process of nodes), free memory, and free disk, bytes.
_SHARED_MEMORY, _MEMORY, _DISK = 70 * _MB, 1500 * _MB, 500 * _MB
_JAZZY = "jazzy"
#: Oldest versions that work. They are the same as in setup.py.
OLDEST = {"numpy": (1, 26), "opencv-python-headless": (4, 6)}
#: Largest number of a ROS domain; and domains with UDP ports that Linux also gives to other programs.
_LAST_DOMAIN, _RISKY_DOMAINS = 232, range(102, 215)
#: What to do about shared memory that killed processes have left and that stops new processes.
_CLEAN_SHARED_MEMORY = (
    "stop all ROS programs, then: rm -f /dev/shm/fast{rtps,dds}_* /dev/shm/sem.fast{rtps,dds}_*"
)
#: By name of an extra (optional dependencies in setup.py): modules that it installs.
EXTRAS = {
    "evaluate": ("c3d", "mcap", "pycocotools", "rosbags"),
    "export": ("OpenEXR", "c3d", "mcap", "pxr", "pycocotools"),
    "exr": ("OpenEXR",),
    "meshes": ("DracoPy",),
    "photographs": ("xatlas",),
    "plot": ("matplotlib",),
    "pytest": ("pytest",),
    "ray": ("fsspec", "mcap", "ray", "rosbags"),
    "record": ("mcap", "rosbags"),
    "rerun": ("rerun",),
    "view": ("ruamel.yaml", "viser"),
}

_IMPORTS = """
import numpy, scipy, cv2, moderngl, trimesh, pydantic, yaml
print(numpy.__version__, cv2.__version__)
"""
_RENDER = """
import json, time
import humansim_ros
from humansim_ros.render import GLRenderer
from humansim_ros import Camera, load_human
from humansim_ros.render import Body
from humansim_ros.files.reading.assets import resource_path
child = load_human(resource_path("assets/humans/child.npz"))
# another camera for each picture: the renderer keeps pictures
cameras = [Camera.look_at((0.1 * n, 1, 3), (0, 0.6, 0), size=(640, 480), up=(0, 1, 0)) for n in range(6)]
renderer = GLRenderer()
bodies = [Body(child.mesh, child.mesh.vertices.astype("float32"), child.triangle_parts, 1)]
renderer.render(bodies, cameras[0], ("rgb",))
start = time.perf_counter()
for camera in cameras[1:]:
    renderer.render(bodies, camera, ("rgb",))
print(json.dumps({"device": renderer.device, "ms": 200 * (time.perf_counter() - start)}))
"""
_EXCHANGE = """
import time
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String
got, nodes, contexts = [], [], []
executor = None
for name in ("doctor_1", "doctor_2"):
    context = rclpy.Context()
    rclpy.init(context=context)
    contexts.append(context)
    node = Node(name, context=context)
    nodes.append(node)
executor = SingleThreadedExecutor(context=contexts[1])
executor.add_node(nodes[1])
nodes[1].create_subscription(String, "/humansim_doctor", lambda message: got.append(message.data), 1)
publisher = nodes[0].create_publisher(String, "/humansim_doctor", 1)
start = time.monotonic()
while not got and time.monotonic() - start < 20:
    publisher.publish(String(data="hello"))
    executor.spin_once(timeout_sec=0.1)
import os, sys
print("arrived" if got else "lost", flush=True)
os._exit(0 if got else 1)
"""


@dataclass(frozen=True)
class Diagnosis:
    """Result of one check.

    Attributes:
        state: Result.
        text: What was found.
        fix: Command to type, or other advice. Empty if there is nothing to do.
    """

    state: State
    text: str
    fix: str = ""


def check_python() -> Diagnosis:
    """Check the version of Python, and whether the packages that are always needed can be imported."""
    version = ".".join(map(str, sys.version_info[:3]))
    if not (3, 10) <= sys.version_info[:2] <= (3, 13):
        return Diagnosis("wrong", version, "use Python 3.10 to 3.13")
    done = run_python(_IMPORTS)
    if done.returncode != 0:
        return Diagnosis("wrong", f"{version}; {last_line(done.stderr)}", _mending_packages(done.stderr))
    found = done.stdout.split()
    text = f"{version}, NumPy {found[0]}, OpenCV {found[1]}"
    for (package, oldest), number in zip(OLDEST.items(), found, strict=True):
        if tuple(map(int, re.findall(r"\d+", number)[:2])) < oldest:
            at_least = ".".join(map(str, oldest))
            return Diagnosis("wrong", f"{text}: too old", f"pip install --upgrade '{package}>={at_least}'")
    return Diagnosis("ok", text)


def _mending_packages(error: str) -> str:
    """Command that mends packages that cannot be imported."""
    if "compiled using NumPy 1" in error or "numpy.core.multiarray" in error:
        return "pip install 'numpy<2'   # SciPy or OpenCV of the system are made for NumPy 1"
    return "pip install --upgrade humansim_ros"


def check_opengl() -> Diagnosis:
    """Check OpenGL: which device renders, and how fast it is."""
    done = run_python(_RENDER)
    if done.returncode != 0:
        return Diagnosis(
            "wrong",
            last_line(done.stderr) or f"the renderer ended with exit code {done.returncode}",
            "sudo apt-get install -y libegl1 libgl1 libgl1-mesa-dri",
        )
    found = json.loads(last_line(done.stdout))
    text = f"{found['device']}; 640x480 in {found['ms']:.0f} ms"
    if "llvmpipe" in found["device"] and list(Path("/dev").glob("nvidia[0-9]*")):
        return Diagnosis(
            "warning",
            f"{text}; there is an NVIDIA GPU, but EGL does not offer it",
            "install libnvidia-gl of the driver; in Docker: --gpus all -e NVIDIA_DRIVER_CAPABILITIES=all",
        )
    return Diagnosis("ok", text)


def check_ros(environment: Mapping[str, str] = os.environ) -> Diagnosis:
    """Check which ROS 2 is used."""
    distribution = environment.get("ROS_DISTRO")
    if distribution not in (None, "", _JAZZY):
        return Diagnosis(
            "wrong",
            f"ROS {distribution} is sourced; this package is for Jazzy",
            "open a new shell and: source /opt/ros/jazzy/setup.bash",
        )
    code = "import rclpy, sensor_msgs.msg, visualization_msgs.msg; print(rclpy.__file__)"
    done = run_python(code, environment)
    if done.returncode != 0:
        fix = (
            "source /opt/ros/jazzy/setup.bash"
            if Path("/opt/ros/jazzy").exists()
            else ("pip install 'humansim_ros[ros]'")
        )
        text = f"cannot be imported ({last_line(done.stderr)}); all that needs no ROS works"
        return Diagnosis("warning", text, fix)
    path = last_line(done.stdout)
    if distribution and "site-packages" in path and "/opt/ros" not in path:
        text = f"/opt/ros/{distribution} is sourced, but Python uses the wheels in {Path(path).parents[1]}"
        return Diagnosis("warning", text, "unset PYTHONPATH AMENT_PREFIX_PATH ROS_DISTRO, or leave the venv")
    return Diagnosis("ok", f"Jazzy, {Path(path).parents[1]}")


def check_variables(environment: Mapping[str, str] = os.environ) -> Diagnosis:
    """Check the environment variables that decide which nodes see each other."""
    domain = environment.get("ROS_DOMAIN_ID", "")
    if domain and not (domain.isdecimal() and int(domain) <= _LAST_DOMAIN):
        text = f"ROS_DOMAIN_ID is {domain!r}, not 0 to {_LAST_DOMAIN}"
        return Diagnosis("wrong", text, "export ROS_DOMAIN_ID=0")
    reach = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "")
    if reach and reach not in ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT"):
        text = f"ROS_AUTOMATIC_DISCOVERY_RANGE is {reach!r}"
        return Diagnosis("wrong", text, "export ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET   # or LOCALHOST")
    if reach == "OFF":
        text = "ROS_AUTOMATIC_DISCOVERY_RANGE is OFF: nodes do not find each other"
        return Diagnosis("wrong", text, "export ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET   # or LOCALHOST")
    middleware = environment.get("RMW_IMPLEMENTATION", "")
    if middleware not in ("", "rmw_fastrtps_cpp"):
        text = f"RMW_IMPLEMENTATION is {middleware}; only rmw_fastrtps_cpp is tested"
        return Diagnosis("warning", text, "unset RMW_IMPLEMENTATION")
    if environment.get("ROS_LOCALHOST_ONLY", "0") not in ("", "0"):
        text = "ROS_LOCALHOST_ONLY is deprecated in Jazzy, and wins over the discovery range"
        fix = "unset ROS_LOCALHOST_ONLY; export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST"
        return Diagnosis("warning", text, fix)
    if int(domain or 0) in _RISKY_DOMAINS:
        text = f"ROS_DOMAIN_ID is {domain}: other programs may have taken its UDP ports"
        return Diagnosis("warning", text, "export ROS_DOMAIN_ID=42   # 0 to 101")
    return Diagnosis("ok", f"domain {domain or 0}, discovery {reach or 'SUBNET'}")


def check_exchange() -> Diagnosis:
    """Check whether a message from one DDS participant reaches another on this machine."""
    if not _is_there("rclpy"):
        return Diagnosis("ok", "not tried without ROS")
    done = run_python(_EXCHANGE)
    if "arrived" in done.stdout:
        return Diagnosis("ok", "a message went from one participant to another")
    if done.returncode == _TIMED_OUT:
        return Diagnosis("wrong", last_line(done.stderr), _CLEAN_SHARED_MEMORY)
    text = "a message did not arrive" if "lost" in done.stdout else last_line(done.stderr) or "no answer"
    fix = "export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST; allow UDP multicast on lo, or see docs/live.md"
    return Diagnosis("wrong", text, fix)


def check_tf() -> Diagnosis:
    """Check whether cameras can publish poses on /tf. The messages for /tf are not on PyPI."""
    if not _is_there("rclpy"):
        return Diagnosis("ok", "not tried without ROS")
    done = run_python("import tf2_msgs.msg; tf2_msgs.msg.TFMessage(); print(tf2_msgs.__file__)")
    if done.returncode == 0:
        return Diagnosis("ok", f"tf2_msgs, {Path(last_line(done.stdout)).parent}")
    fix = (
        "sudo apt-get install -y ros-jazzy-tf2-msgs"
        if Path("/opt/ros/jazzy").exists()
        else "make tf2_msgs   # in the folder of the repository"
    )
    return Diagnosis("ok", "tf2_msgs is not installed: cameras publish no /tf and /tf_static", fix)


def check_shared_memory(folder: Path = Path("/dev/shm")) -> Diagnosis:
    """Check space and access rights of the folder of shared memory, through which images are sent."""
    if not os.access(folder, os.W_OK):
        return Diagnosis("wrong", f"{folder} cannot be written to", f"sudo chmod 1777 {folder}")
    free = free_memory(folder)
    left = len(files_of_fast_dds(folder))
    text = f"{folder} has no limit" if math.isinf(free) else f"{free // _MB:.0f} MB free in {folder}"
    if left:
        text += f", {left} files of Fast DDS"
    if free < _SHARED_MEMORY:
        fix = "sudo mount -o remount,size=1G /dev/shm; in Docker: --shm-size=1g"
        if left:
            fix += f"; or {_CLEAN_SHARED_MEMORY}"
        return Diagnosis("warning", f"{text}: large images go through UDP", fix)
    return Diagnosis("ok", text)


def check_ffmpeg() -> Diagnosis:
    """Check ffmpeg, the program that writes videos."""
    code = "import imageio_ffmpeg; print(imageio_ffmpeg.get_ffmpeg_exe())"
    done = run_python(code)
    if done.returncode != 0:
        return Diagnosis("warning", "no videos can be written", "pip install --upgrade imageio-ffmpeg")
    return Diagnosis("ok", last_line(done.stdout))


def check_extras() -> Diagnosis:
    """Report optional dependencies that are not installed."""
    missing = [name for name, modules in EXTRAS.items() if not all(map(_is_there, modules))]
    if not missing:
        return Diagnosis("ok", "all are installed")
    fix = f"pip install 'humansim_ros[{','.join(missing)}]'"
    return Diagnosis("ok", f"not installed: {', '.join(missing)}", fix)


def check_fbx() -> Diagnosis:
    """Check the program that converts FBX files."""
    try:
        found = find_converter(Path("PERSON.fbx"), HumansimError)
    except HumansimError as error:
        if os.environ.get(FBX_VARIABLE):
            return Diagnosis("warning", error.message, f"unset {FBX_VARIABLE}")
        fix = f"install Blender; or pip install bpy, with {FBX_VARIABLE}=PYTHON in another environment"
        return Diagnosis("ok", "no converter: FBX files are not read", fix)
    kind = {"python": "bpy of", "blender": "Blender:", "FBX2glTF": "FBX2glTF:"}[found.kind]
    return Diagnosis("ok", f"read with {kind} {found.program}")


def check_machine(folder: Path | None = None) -> Diagnosis:
    """Check cores, memory and disk. ``folder``: folder on the checked disk; if None, the current one."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    free = shutil.disk_usage(folder or Path.cwd()).free
    memory = available_memory()
    text = f"{cores} cores, {memory // _MB} MB of memory and {free // _MB} MB of disk free"
    if memory < _MEMORY:
        return Diagnosis("warning", text, "close other programs: a scene with four cameras takes 1.5 GB")
    if free < _DISK:
        return Diagnosis("warning", text, "free some disk: bags and data sets take gigabytes")
    return Diagnosis("ok", text)


#: All checks by name, in the order of the output.
CHECKS: Mapping[str, Callable[[], Diagnosis]] = {
    "Python": check_python,
    "machine": check_machine,
    "OpenGL": check_opengl,
    "ROS": check_ros,
    "ROS variables": check_variables,
    "shared memory": check_shared_memory,
    "DDS": check_exchange,
    "tf": check_tf,
    "ffmpeg": check_ffmpeg,
    "FBX": check_fbx,
    "extras": check_extras,
}


def diagnoses(checks: Mapping[str, Callable[[], Diagnosis]]) -> Iterator[tuple[str, Diagnosis]]:
    """Run checks, and yield names and results. A check that raises an error counts as wrong."""
    for name, check in checks.items():
        try:
            yield name, check()
        except Exception as error:  # a check must never stop the others
            yield name, Diagnosis("wrong", f"could not be checked: {error}", "tell us about it")


def run_python(code: str, environment: Mapping[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    """Run code in a separate process, since it may crash or hang. If it hangs, the exit code is 124."""
    command = [sys.executable, "-c", code]
    try:
        return subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=_PATIENCE,
            env=dict(environment) if environment is not None else None,
            stdin=subprocess.DEVNULL,
        )
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(command, _TIMED_OUT, "", f"no answer within {_PATIENCE:g} s")


def last_line(text: str) -> str:
    """Return the last line of a text that is not empty."""
    lines = [line for line in text.splitlines() if line.strip()]
    return lines[-1].strip() if lines else ""


def available_memory(path: Path = Path("/proc/meminfo")) -> int:
    """Memory that programs can still take, bytes."""
    for line in path.read_text().splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    return 0


def _is_there(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ImportError:
        return False


_MARKS = {"ok": "ok     ", "warning": "warning", "wrong": "WRONG  "}


def doctor(
    as_json: bool = False,
) -> None:
    """Check this machine (OpenGL, ROS, DDS, shared memory …), and print the line that mends what is wrong."""
    found = []
    for name, finding in diagnoses(CHECKS):
        found.append({"name": name, **asdict(finding)})
        if not as_json:
            print_text(f"{_MARKS[finding.state]}  {name}: {finding.text}")
            if finding.fix:
                print_text(f"           → {finding.fix}")
    if as_json:
        print_text(to_json(found))
    if any(each["state"] == "wrong" for each in found):
        raise typer.Exit(1)
