"""Programs that are not installed: every import resolves, and a short run of each program ends well."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import ROOT, SHARED_DATA
from waiting import PATIENCE

#: Options that make a run short; OUT is a temporary folder. Every program of benchmarks/ is here.
BENCHMARKS = {
    "bvh_reading": (),
    "close_detector": ("--help",),  # the detector has an environment of its own
    "conventions": ("--rings", "2"),
    "core": ("--rounds", "2"),
    "distinct": ("--count", "2"),
    "fit": ("--seeds", "1", "--frames", "4"),
    "gpu": ("--seconds", "0.1", "--cases", "1x320x240x1"),
    "lenses": ("--rounds", "2"),
    "live": ("--seconds", "1", "--cases", "rgb + info + depth + part", "--processes", "1"),
    "lockstep": ("--frames", "10", "--sleep", "0.01"),
    "look": ("--rounds", "2"),
    "many": ("--frames", "2", "--counts", "1", "2"),
    "pose_detector": ("--help",),  # the detector has an environment of its own
    "record": ("--frames", "4", "--jobs", "1"),
    "recorder": ("--seconds", "1"),
    "rigging": ("--rounds", "1"),
    "scaling": ("--rounds", "2"),
    "scanners": ("--rounds", "1", "--people", "1", "--models", "velodyne_vlp16", "livox_mid360"),
    "sensor": ("--rounds", "2"),
    "skinning": (),
    "texture": ("--rounds", "1", "--size", "160", "120"),
    "view": ("--seconds", "2", "--people", "1", "--cameras", "1"),
}
#: Programs of tools/ that run here, without Blender, other environments, and the sources of the assets.
#: Tests of their own run doc_pages, fuzz, fuzz_nodes, field_hashes, check_export, build_interfaces.
TOOLS = {
    "chaos": ("--kills", "1", "--stops", "0", "--processes", "1"),
    "kill_nodes": ("--kills", "1", "--processes", "1"),
    "soak": ("--minutes", "1", "--warm-up", "1"),
    "assets/make_motions": ("wave", "--folder", "OUT"),
    "assets/make_walk": ("--output", "OUT/walk.bvh"),
    "figures/body_sheet": ("OUT/sheet.jpg", "child"),
    "figures/face_sheet": ("OUT/faces.jpg", "child"),
    "figures/calibration_sheet": (f"{SHARED_DATA}/calib", "-o", "OUT/sheet.jpg"),
    "figures/deformation_figures": ("child", "--motions", "wave"),
    "figures/draw_capsules": ("OUT/capsules.png",),
    "figures/fault_figures": ("OUT/faults.jpg",),
    "figures/furniture_picture": ("OUT/furniture.jpg",),
    "figures/home_animation": ("OUT/home.webp",),
    "figures/joint_figure": ("OUT/joints.png",),
    "figures/keypoint_figure": ("OUT/keypoints.jpg",),
    "figures/lens_picture": ("OUT/lenses.jpg",),
    "figures/library_figures": (),
    "figures/lockstep_figure": ("OUT/lockstep.svg",),
    "figures/look_pictures": ("-o", "OUT"),
    "figures/motion_figures": (f"{SHARED_DATA}/bvh",),
    "figures/motion_sheet": (f"{SHARED_DATA}/bvh", "-o", "OUT/sheet.jpg"),
    "figures/rigging_figures": ("joints",),
    "figures/sensor_figures": ("picture", "OUT/sensor.jpg"),
    "figures/scanner_picture": ("OUT/scanners.jpg",),
    "figures/skinning_picture": ("OUT/skinning.jpg",),
    "figures/hand_figure": ("OUT/hands.jpg",),
    "figures/face_scene_picture": ("OUT/faces.jpg",),
    "figures/mouth_picture": ("OUT/mouths.jpg",),
    "figures/snapshot_picture": ("OUT/snapshot.jpg",),
}
PROGRAMS = [
    *(f"benchmarks/{name}.py" for name in BENCHMARKS),
    *(f"tools/{name}.py" for name in TOOLS),
]
FOLDERS = ("benchmarks", "examples", "tools")


def imported_names(path: Path) -> Iterator[tuple[str, str]]:
    """Module and name of each import of the package, anywhere in a file; the name is empty for a module."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "humansim_ros":
            yield from ((node.module or "", alias.name) for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from ((a.name, "") for a in node.names if a.name.partition(".")[0] == "humansim_ros")


@pytest.mark.daily("tools/figures/robot_picture.py", "benchmarks/sensor.py")
@pytest.mark.parametrize(
    "path",
    sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")),
    ids=lambda path: str(path.relative_to(ROOT)),
)
def test_programs_import_names_that_the_package_has(path: Path) -> None:
    for module, name in imported_names(path):
        found = importlib.import_module(module)
        if not hasattr(found, name or "__name__"):
            importlib.import_module(f"{module}.{name}")


def test_every_benchmark_has_a_short_run() -> None:
    assert {path.stem for path in (ROOT / "benchmarks").glob("*.py")} == set(BENCHMARKS)


@pytest.mark.nightly
@pytest.mark.parametrize("program", PROGRAMS)
def test_a_short_run_ends_well(program: str, tmp_path: Path) -> None:
    table = BENCHMARKS if program.startswith("benchmarks/") else TOOLS
    options = table[program.partition("/")[2].removesuffix(".py")]
    if any(str(SHARED_DATA) in option for option in options) and not SHARED_DATA.is_dir():
        pytest.skip("needs shared files (HUMANSIM_SHARED_DATA)")
    command = [sys.executable, str(ROOT / program), *(each.replace("OUT", str(tmp_path)) for each in options)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=5 * PATIENCE)
    last = (done.stderr.strip().splitlines() or [""])[-1]
    if ("No module named" in last and "humansim" not in last) or "pip install" in last:
        pytest.skip(last)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    assert done.stdout or any(tmp_path.iterdir())
