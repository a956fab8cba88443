"""What skinning costs on one core, beside dense products and other people's skinning on PyTorch.

    python benchmarks/skinning.py [HUMAN.npz] [--torch PYTHON] [--json FILE]

``--torch``: a Python that can ``import torch``, ``anny`` and ``smplx``, which are compared: an
environment of its own with ``pip install torch roma smplx pillow pyyaml`` and ``pip install --no-deps
anny==0.6.2``. All take the same vertices, weights and bones in float32, turn and turn about on one core with
one thread, and all must come to the same vertices. The figures are wall-clock milliseconds per frame, of one
frame at a time and of 16 at once: the median of many calls, and of nine such the best, which other programs
have disturbed least. Read the ratios.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
FRAMES = 16
ROUNDS = 9
#: Milliseconds that one measurement lasts.
LASTING = 40.0

Floats = NDArray[np.float32]
#: Takes transforms (F, B, 4, 4), gives vertices (F, V, 3); and what they must be: "linear", "dual" or "".
Contestants = dict[str, tuple[Callable[[Floats], object], str]]


def ours(arrays: dict[str, NDArray[np.floating]]) -> Contestants:
    from scipy.sparse import csr_matrix

    from humansim_ros.files.mesh.normals import SurfaceNormals, SurfaceTangents
    from humansim_ros.motion.body.skinning import DualQuaternion, LinearBlend

    vertices, dense = arrays["vertices"], arrays["weights"]
    weights = csr_matrix(dense)
    linear, dual = LinearBlend(vertices, weights), DualQuaternion(vertices, weights)
    normals, homogeneous = arrays["normals"], np.pad(vertices, [(0, 0), (0, 1)], constant_values=1)
    angle, area = (
        SurfaceNormals(arrays["triangles"].astype(int), len(vertices), w) for w in ("angle", "area")
    )

    uv, uv_triangles = arrays["uv"], arrays["uv_triangles"].astype(int)
    tangents = SurfaceTangents(arrays["triangles"].astype(int), uv, uv_triangles, len(vertices))

    def with_tangents(transforms: Floats) -> Floats:
        posed = linear(transforms)
        return tangents(posed, angle(posed))

    def einsum(transforms: Floats) -> Floats:
        one = [np.einsum("vb,bij->vij", dense, t) for t in transforms]
        return np.stack([np.einsum("vij,vj->vi", m[:, :3], homogeneous) for m in one])

    def product(transforms: Floats) -> Floats:
        one = [(dense @ t.reshape(-1, 16)).reshape(-1, 4, 4) for t in transforms]
        return np.stack([np.einsum("vij,vj->vi", m[:, :3], homogeneous) for m in one])

    return {
        "linear": (linear, "linear"),
        "linear, and normals by the bones": (
            lambda t: (linear(t), linear.directions(t, normals))[0],
            "linear",
        ),
        "linear, and normals anew, by area": (lambda t: area(linear(t)), ""),
        "linear, and normals anew, by angle": (lambda t: angle(linear(t)), ""),
        "linear, normals and tangents anew": (with_tangents, ""),
        "dual quaternion": (dual, "dual"),
        "dual quaternion, and normals by the bones": (
            lambda t: (dual(t), dual.directions(t, normals))[0],
            "dual",
        ),
        "NumPy, dense: einsum (V, B) x (B, 4, 4)": (einsum, "linear"),
        "NumPy, dense: BLAS product (V, B) x (B, 16)": (product, "linear"),
    }


def local_turns(arrays: dict[str, NDArray[np.floating]]) -> tuple[Floats, Floats]:
    """Rotations (F, B, 3, 3) of the bones in their parents, and what smplx adds to all vertices (F, 3)."""
    transforms, parents = arrays["transforms"], arrays["parents"].astype(int)
    turns = transforms[..., :3, :3]
    local = np.swapaxes(turns[:, parents], -1, -2) @ turns
    root = int(np.flatnonzero(parents < 0)[0])
    local[:, root] = turns[:, root]
    way = transforms[:, root, :3, 3] - arrays["heads"][root] + turns[:, root] @ arrays["heads"][root]
    return local.astype(np.float32), way.astype(np.float32)


def torchs(arrays: dict[str, NDArray[np.floating]]) -> tuple[Contestants, list[str]]:
    """Those of PyTorch, and the names of missing packages."""
    import torch

    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    vertices, weights = (torch.from_numpy(arrays[key]) for key in ("vertices", "weights"))
    parents = torch.from_numpy(arrays["parents"].astype(np.int64))
    out: Contestants = {}
    missing = []
    try:
        from anny.skinning.skinning import dense_linear_blend_skinning, dual_quaternion_skinning

        most = int((weights > 0).sum(1).max())
        values, bones = weights.topk(most, dim=1)
        out[f"Anny {version('anny')}, linear, torch"] = (
            lambda t: dense_linear_blend_skinning(vertices[None], weights, torch.from_numpy(t)).numpy(),
            "linear",
        )
        out[f"Anny {version('anny')}, dual quaternion, torch"] = (
            lambda t: dual_quaternion_skinning(
                vertices[None], values[None], bones[None], torch.from_numpy(t)
            ).numpy(),
            "dual",
        )
    except ImportError as reason:
        missing.append(f"Anny: {reason}")
    try:
        from smplx.lbs import lbs

        count, joints = len(vertices), len(parents)
        count, joints = len(vertices), len(parents)
        shape, pose = torch.zeros(count, 3, 1), torch.zeros(9 * (joints - 1), 3 * count)
        # joints as sums of vertices: any sums will do
        regressor = torch.from_numpy(
            (arrays["heads"] @ np.linalg.pinv(arrays["vertices"])).astype(np.float32)
        )
        turns, way = (torch.from_numpy(array) for array in local_turns(arrays))
        out[f"smplx {version('smplx')} lbs, torch: blend shapes and all"] = (
            lambda t: (
                lbs(
                    torch.zeros(len(t), 1), turns[: len(t)], vertices[None].expand(len(t), -1, -1), shape,
                    pose, regressor, parents, weights, pose2rot=False,
                )[0] + way[: len(t), None]
            ).numpy(),
            "linear",
        )  # fmt: skip
        feature = torch.zeros(FRAMES, 9 * (joints - 1))
        out["  of which its pose blend shapes"] = (lambda t: feature[: len(t)] @ pose, "")
    except ImportError as reason:
        missing.append(f"smplx: {reason}")
    return out, missing


def measure(run: Callable[[Floats], object], transforms: Floats) -> float:
    """Median milliseconds of a call, for as long as LASTING."""
    run(transforms)
    times: list[float] = []
    while sum(times) < LASTING:
        start = time.perf_counter()
        run(transforms)
        times.append((time.perf_counter() - start) * 1e3)
    return statistics.median(times)


def figures(contestants: Contestants, name: str, arrays: dict[str, NDArray[np.floating]]) -> list[float]:
    """Milliseconds of one frame, and per frame of many at once, and metres off the right vertices."""
    run, expected = contestants[name]
    transforms = arrays["transforms"].astype(np.float32)
    off = float(np.abs(np.asarray(run(transforms)) - arrays[expected]).max()) if expected else 0.0
    return [measure(run, transforms[:1]), measure(run, transforms) / len(transforms), off]


def serve(path: str) -> None:
    """Measures the contestants of PyTorch by name, as asked line by line."""
    with np.load(path) as archive:
        arrays = dict(archive)
    contestants, missing = torchs(arrays)
    print(json.dumps([list(contestants), missing]), flush=True)
    for line in sys.stdin:
        print(json.dumps(figures(contestants, line.rstrip("\n"), arrays)), flush=True)


class Guest:
    """A process that measures the contestants of PyTorch."""

    def __init__(self, python: str, path: Path) -> None:
        self._process = subprocess.Popen(
            [python, __file__, "--serve", str(path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        answer = self._read()
        self.names, self.missing = answer if answer else ([], [f"PyTorch: {python} cannot import torch"])

    def figures(self, name: str) -> list[float]:
        assert self._process.stdin is not None
        print(name, file=self._process.stdin, flush=True)
        return list(self._read())

    def _read(self) -> list:  # type: ignore[type-arg]
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        return json.loads(line) if line else []

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(10)


def body(path: Path) -> dict[str, NDArray[np.floating]]:
    """The arrays that all contestants get, and the right results in double precision."""
    from humansim_ros.files.mesh.normals import SurfaceNormals
    from humansim_ros.motion import read_bvh
    from humansim_ros.motion.body.skinning import skin
    from humansim_ros.motion.pose.retarget import Retargeter
    from humansim_ros.motion.pose.world_motion import to_world
    from humansim_ros.people.loading.loading import load_human

    human = load_human(path)
    world = to_world(read_bvh(ROOT / "assets" / "motions" / "walk.bvh"))
    times = world.frame_times
    times = times[np.linspace(0, len(times) - 1, FRAMES).astype(int)]
    posed = Retargeter.fit(world, human.skeleton).pose(world.sample(times))
    transforms = posed @ human.skeleton.rest_inverse
    vertices, mesh = human.mesh.vertices, human.mesh
    if mesh.uv is None or mesh.uv_triangles is None:
        raise SystemExit(f"{path}: the benchmark needs a human with texture coordinates")
    return {
        "vertices": vertices.astype(np.float32),
        "weights": human.weights.toarray().astype(np.float32),
        "triangles": mesh.triangles,
        "uv": mesh.uv,
        "uv_triangles": mesh.uv_triangles,
        "normals": SurfaceNormals(mesh.triangles, len(vertices))(vertices).astype(np.float32),
        "parents": human.skeleton.parents,
        "heads": human.skeleton.heads,
        "transforms": transforms,
        "linear": skin(vertices, human.weights, transforms),
        "dual": skin(vertices, human.weights, transforms, "dual_quaternion"),
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("human", nargs="?", type=Path, default=ROOT / "assets" / "humans" / "adult_man.npz")
    parser.add_argument("--torch", metavar="PYTHON", help="compare with what this Python can import")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there too")
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve(options.serve)
        return 0

    arrays = body(options.human)
    contestants = ours(arrays)
    count, bones = arrays["weights"].shape
    print(f"{options.human.stem}: {count} vertices, {bones} bones, {len(arrays['triangles'])} triangles\n")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "body.npz"
        np.savez(path, **arrays)
        guest = Guest(options.torch, path) if options.torch else None
        found: dict[str, list[list[float]]] = {}
        for _ in range(ROUNDS):
            for name in contestants:
                found.setdefault(name, []).append(figures(contestants, name, arrays))
            for name in guest.names if guest else ():
                found.setdefault(name, []).append(guest.figures(name))  # type: ignore[union-attr]
        if guest:
            guest.close()
    results = {name: [min(column) for column in zip(*rows, strict=True)] for name, rows in found.items()}
    first, *_ = results.values()
    print(f"{'ms per frame, one core':<48} {'one':>7} {'x':>6} {f'{FRAMES} at once':>11} {'x':>6}")
    for name, (one, many, off) in results.items():
        wrong = f"  WRONG by {off:.1g} m" if off > 1e-5 else ""
        print(f"{name:<48} {one:7.3f} {one / first[0]:6.2f} {many:11.3f} {many / first[1]:6.2f}{wrong}")
    for line in guest.missing if guest else ["PyTorch (Anny, smplx): --torch is not given"]:
        print(f"missing: {line}")
    if options.json:
        options.json.write_text(json.dumps(results, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
