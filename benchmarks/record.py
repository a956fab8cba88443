"""Rate of ``humansim record``, beside Blender Workbench and pyrender writing the same frames as PNG.

    python benchmarks/record.py [--frames 150] [--blender PYTHON] [--json FILE]

All rows record the same frames of the demo scene (four cameras, 640x480) to the same disk in one run. A bag
has rgb, depth, part, camera_info and joints of each camera, and joints and vertices of the human. ``/s`` is
the rate with the start of the processes, ``steady`` the rate from the first frame on, as the command prints
it. ``/CPU h`` counts the camera-frames for an hour of processor time of all processes, without the first
rendering of each. ``slower`` is the steady rate of the first row divided by that of the row.

pyrender draws the same scene and channels through its renderer in this package, and OpenCV writes three PNG
files for each camera-frame. Blender draws the body alone, without room and labels, and writes one PNG file
without compression. It runs in a Python that has bpy (``python3.11 -m venv blender && blender/bin/pip install
bpy==4.5.15``), named by --blender or HUMANSIM_BENCH_BLENDER; without one its row is left out. ``plain write``
writes as many bytes as the raw bag has, in pieces of 2.5 MB, to the same disk.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

os.environ.setdefault("PYOPENGL_PLATFORM", "egl")

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from core import guest, shots  # noqa: E402

from humansim_ros.errors import RenderError  # noqa: E402
from humansim_ros.render import make_renderer  # noqa: E402
from humansim_ros.scene import Scene, Simulation  # noqa: E402

#: Options of `humansim record` by title.
FORMATS = {
    "raw": (),
    "raw, zstd chunks": ("--compression", "zstd"),
    "raw, lz4 chunks": ("--compression", "lz4"),
    "JPEG and PNG depth": ("--images", "jpeg", "--depth", "png"),
    "PNG and PNG depth": ("--images", "png", "--depth", "png"),
}
CHANNELS = ("rgb", "depth", "instance", "part")
#: Least number of frames of a row.
_LEAST = 8
_PIECE = 2_500_000
#: Millimetres in depth files of 16 bits.
_DEPTH_SCALE = 1000.0


@dataclass
class Row:
    """Figures of one way to record.

    Attributes:
        title: Way to record.
        jobs: Number of processes.
        rate: Camera-frames per second with the start of the processes.
        steady: Camera-frames per second without it.
        per_cpu_hour: Camera-frames for an hour of processor time; 0 if unknown.
        size: Bytes for each camera-frame; 0 if unknown.
    """

    title: str
    jobs: int
    rate: float
    steady: float
    per_cpu_hour: float = 0.0
    size: float = 0.0

    def line(self, reference: Row) -> str:
        return (
            f"{self.title:<58} {self.jobs:4} {self.rate:8.1f} {self.steady:8.1f} "
            f"{self.steady * self.size / 1e6:8.1f} {self.size / 1e3:8.0f} {self.per_cpu_hour:9.0f} "
            f"{reference.steady / self.steady:7.2f}"
        )


@contextmanager
def clocks() -> Iterator[list[float]]:
    """Wall-clock and processor seconds of the block, with those of its child processes, as a list."""

    def cpu() -> float:
        kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
        return sum(u.ru_utime + u.ru_stime for u in map(resource.getrusage, kinds))

    taken: list[float] = []
    start, start_cpu = time.perf_counter(), cpu()
    yield taken
    taken += [time.perf_counter() - start, cpu() - start_cpu]


def folder_size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def record(title: str, jobs: int, frames: int, cameras: int, folder: Path) -> Row:
    """Run `humansim record`, and read its own figures: its rate begins with the first frame."""
    output = folder / "bag"
    command = [sys.executable, "-m", "humansim_ros.cli", "record", "-o", str(output)]
    command += ["--frames", str(frames), "--jobs", str(jobs), *FORMATS[title]]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    start = time.perf_counter()
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    seconds = time.perf_counter() - start
    size, count = folder_size(output), frames * cameras
    remove(output)
    (rate,) = re.findall(r"([\d.]+) camera-frames/s", done.stdout)
    costs = re.findall(r"([a-z ]+) ([\d.]+)", done.stdout.partition("per camera-frame: ")[2])
    milliseconds = sum(float(cost) for step, cost in costs if not step.strip().startswith("first"))
    return Row(
        f"humansim record, {title}",
        jobs,
        rate=count / seconds,
        steady=float(rate),
        per_cpu_hour=3.6e6 / milliseconds,
        size=size / count,
    )


def remove(folder: Path) -> None:
    for path in sorted(folder.rglob("*"), reverse=True):
        path.unlink() if path.is_file() else path.rmdir()
    folder.rmdir()


def pyrender(scene: Scene, frames: int, folder: Path) -> Row:
    """Simulate with pyrender, and write colour, depth and parts of each view as PNG files."""
    renderer = make_renderer("pyrender", scene.static_meshes, scene.environment.lighting)
    with Simulation(scene, CHANNELS, renderer=renderer) as simulation:

        def write(index: int) -> None:
            frame = simulation.frame(index)
            for name, view in frame.views.items():
                depth = np.clip(view.depth * _DEPTH_SCALE, 0, 65535).astype(np.uint16)
                images = {"rgb": view.rgb[..., ::-1], "depth": depth, "part": view.part}
                for channel, image in images.items():
                    cv2.imwrite(str(folder / f"{name}_{channel}_{index:06}.png"), image)
                _ = frame.joints

        write(0)
        with clocks() as taken:
            for index in range(1, frames + 1):
                write(index)
    count = frames * len(scene.cameras)
    rate, size = count / taken[0], folder_size(folder) / (count + len(scene.cameras))
    return Row("pyrender: rgb, depth, part as PNG, joints", 1, rate, rate, 3600 * count / taken[1], size)


def blender(scene: Scene, python: str, frames: int) -> Row | None:
    """Draw the body in Blender Workbench, one PNG file for each camera-frame; None without bpy."""
    order = shots(scene, frames)
    with guest("blender", python, order) as (title, draw):
        if not title:
            return None
        draw(order[0])
        rate = 1000 * frames / sum(draw(shot) for shot in order)
    return Row(title, 1, rate, rate)


def plain_write(size: int, folder: Path, sync: bool) -> float:
    """Seconds to write a file of a size in pieces; ``sync``: until the disk has it."""
    piece = np.random.default_rng(1).integers(0, 256, _PIECE, np.uint8).tobytes()
    path = folder / "plain"
    with clocks() as taken, path.open("wb", buffering=0) as file:
        for _ in range(max(1, size // _PIECE)):
            file.write(piece)
        if sync:
            os.fsync(file.fileno())
    path.unlink()
    return taken[0]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--frames", type=int, default=150, help="frames of a recording (default: %(default)s)"
    )
    parser.add_argument("--jobs", type=int, nargs="+", default=[1, 2], help="numbers of processes")
    parser.add_argument(
        "--formats", nargs="+", choices=list(FORMATS), default=list(FORMATS), metavar="FORMAT"
    )
    parser.add_argument("--folder", type=Path, help="folder on the disk to measure (default: that of TMPDIR)")
    parser.add_argument(
        "--blender",
        metavar="PYTHON",
        default=os.environ.get("HUMANSIM_BENCH_BLENDER", sys.executable),
        help="a Python that can import bpy (default: $HUMANSIM_BENCH_BLENDER, or this one)",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there too")
    options = parser.parse_args()
    frames = max(2 * _LEAST, options.frames)
    scene = Scene.load()
    cameras = len(scene.cameras)
    print(f"{os.cpu_count()} cores; {frames} frames of {cameras} cameras, 640x480")
    titles = ("camera-frames", "jobs", "/s", "steady", "MB/s", "kB each", "/CPU h", "slower")
    print("{:<58} {:>4} {:>8} {:>8} {:>8} {:>8} {:>9} {:>7}".format(*titles))
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(dir=options.folder) as name:
        folder = Path(name)

        def add(row: Row) -> None:
            rows.append(row)
            print(row.line(rows[0]), flush=True)

        for title in options.formats:
            for jobs in options.jobs:
                add(record(title, jobs, frames, cameras, folder))
        try:
            add(pyrender(scene, max(_LEAST, frames // 8), folder))
        except RenderError as reason:
            print(f"pyrender: left out ({reason})")
        if row := blender(scene, options.blender, max(_LEAST, frames // 2)):
            add(row)
        else:
            print(f"Blender: left out, as {options.blender} has no bpy (--blender PYTHON)")
        size = round(rows[0].size * frames * cameras)
        disk = {
            kind: size / plain_write(size, folder, kind == "synchronised") for kind in ("", "synchronised")
        }
    for kind, rate in disk.items():
        print(f"plain write of the same bytes{kind and ', '}{kind}: {rate / 1e6:.0f} MB/s")
        print(f"    that is {rate / rows[0].size:.0f} raw camera-frames per second")
    if options.json:
        figures = {"cores": os.cpu_count(), "rows": [asdict(row) for row in rows], "disk_bytes_per_s": disk}
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
