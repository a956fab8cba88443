"""Time to read BVH files, compared with bvhio and Blender's importer on the same file in one run.

    python benchmarks/bvh_reading.py [FILE.bvh ...] [--blender PYTHON]

Without a FILE: the built-in walk, repeated ten times. ``--blender``: a Python that can ``import bpy``. Times
are CPU times, which other programs hardly change: the median of several runs (one run of slow readers). "with
FK" adds the world positions of all joints in all frames. Blender's importer makes keyframes of an armature,
bvhio keyframes of joints.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
import tracemalloc
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from humansim_ros.motion import read_bvh, write_bvh

ROOT = Path(__file__).parent.parent

BLENDER = """
import sys, time, bpy
start = time.process_time()
bpy.ops.import_anim.bvh(
    filepath=sys.argv[1], axis_forward='Y', axis_up='Z', frame_start=1, rotate_mode='QUATERNION'
)
print('SECONDS', time.process_time() - start)
"""


def seconds(task: Callable[[], object], runs: int) -> float:
    times = []
    for _ in range(runs):
        start = time.process_time()
        task()
        times.append(time.process_time() - start)
    return statistics.median(times)


def bvhio_seconds(path: Path) -> tuple[float, float]:
    import bvhio

    def positions() -> None:
        root = bvhio.readAsHierarchy(str(path))
        for frame in range(bvhio.readAsBvh(str(path)).FrameCount):
            root.loadPose(frame)
            for joint, _, _ in root.layout():
                _ = joint.PositionWorld

    return seconds(lambda: bvhio.readAsHierarchy(str(path)), 1), seconds(positions, 1)


def blender_seconds(python: str, path: Path) -> float:
    done = subprocess.run(
        [python, "-c", BLENDER, str(path)], capture_output=True, text=True, timeout=600, check=True
    )
    return float(next(line.split()[1] for line in done.stdout.splitlines() if line.startswith("SECONDS")))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--blender", help="a Python with bpy")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    if options.files:
        compare(options.files, options.blender)
    else:
        with tempfile.TemporaryDirectory() as folder:
            walk = read_bvh(ROOT / "assets" / "motions" / "walk.bvh")
            path = Path(folder) / "walk_10_times.bvh"
            write_bvh(path, replace(walk, values=np.tile(walk.values, (10, 1))))
            compare([path], options.blender)
    return 0


def compare(files: Sequence[Path], blender: str | None) -> None:
    for path in files:
        motion = read_bvh(path)
        frames = motion.n_frames
        ours = seconds(lambda path=path: read_bvh(path), 7)  # type: ignore[misc]
        ours_fk = seconds(lambda path=path: read_bvh(path).world_positions(), 7)  # type: ignore[misc]
        tracemalloc.start()
        read_bvh(path)
        memory = tracemalloc.get_traced_memory()[1] / max(motion.values.nbytes, 1)
        tracemalloc.stop()
        print(f"{path.name}: {frames} frames, {motion.n_joints} joints, {path.stat().st_size / 1e6:.1f} MB")
        print(f"  {'':28}{'CPU s':>9}{'frames/s':>12}{'x ours':>8}")
        rows = [("ours", ours, ours), ("ours, with FK", ours_fk, ours_fk)]
        try:
            theirs, theirs_fk = bvhio_seconds(path)
            rows += [("bvhio", theirs, ours), ("bvhio, with FK", theirs_fk, ours_fk)]
        except Exception as error:  # it cannot read every file
            print(f"  bvhio: {type(error).__name__}: {error}"[:100])
        if blender:
            rows.append(("Blender's importer", blender_seconds(blender, path), ours))
        else:
            print("  Blender: left out (--blender PYTHON)")
        for name, time_taken, against in rows:
            print(f"  {name:28}{time_taken:9.4f}{frames / time_taken:12.0f}{time_taken / against:8.1f}")
        print(f"  memory at its peak: {memory:.1f} times the values")


if __name__ == "__main__":
    sys.exit(main())
