"""The cache of humans: found by content, replaced when damaged, invalid when humans change."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import figures
import numpy as np
import pytest
from conftest import ROOT

from humansim_ros.errors import HumansimWarning
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.people.humans.human import Human
from humansim_ros.people.loading.loading import CACHE_VERSION, MeshHuman, load_human, make_human

pytestmark = pytest.mark.usefixtures("cache")


#: Numbers that stand for the humans which version CACHE_VERSION makes of five small inputs.
FINGERPRINTS = {
    "glTF": [-0.0571, -0.1751, 0.01961, -1.0099, 3.51866],
    "SMPL": [-0.05995, -3.07611, -5.21293, 4.90748, 0.10093],
    "heat": [-0.02978, 0.55372, 0.36422, -2.33413, 2.1856],
    "thesis": [-0.03067, 0.45017, 0.49126, 1.25134, 0.60015],
    "child": [-0.48849, 0.45586, 0.39211, -10.34889, 1.10055],
}


def fingerprint(human: Human) -> list[float]:
    """Projections of vertices, joints, weights and colours: they change when any value changes."""
    arrays = (
        *(human.mesh.vertices, human.skeleton.heads, human.skeleton.tails, human.weights.toarray()),
        np.concatenate([look.ravel() for look in human.looks.values()]) / 255.0,
    )
    return [round(float(np.cos(np.arange(array.size)) @ array.ravel()), 5) for array in arrays]


def obj_file(path: Path, mesh: Mesh) -> Path:
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in mesh.vertices]
    path.write_text("\n".join([*lines, *(f"f {a} {b} {c}" for a, b, c in mesh.triangles + 1)]))
    return path


@pytest.mark.nightly
@pytest.mark.slow
def test_cached_humans_are_those_that_this_version_makes(figure: Path, tmp_path: Path) -> None:
    """The cache does not know the code, so CACHE_VERSION must rise with each change of its results."""
    vertices, triangles, _ = figures.boxes()
    faces = np.column_stack([triangles, np.full(len(triangles), -1)]).astype(np.int32)
    boxes = obj_file(tmp_path / "boxes.obj", Mesh(vertices, faces))
    child = obj_file(tmp_path / "child.obj", load_human(ROOT / "assets" / "humans" / "child.npz").mesh)
    np.savez(tmp_path / "smpl.npz", **figures.smpl(figures.SMPL_NAMES, figures.SMPL_PARENTS))
    humans = {
        "glTF": make_human(figure),
        "SMPL": make_human(tmp_path / "smpl.npz", MeshHuman(betas=(0.5, -1.0))),
        "heat": make_human(boxes, MeshHuman(up="y", facing="z", stature=1.7)),
        "thesis": make_human(boxes, MeshHuman(up="y", facing="z", rigging="thesis", skeleton="general")),
        "child": make_human(child),
    }
    made = {name: fingerprint(human) for name, human in humans.items()}
    advice = f"humans changed: raise CACHE_VERSION (now {CACHE_VERSION}) and set FINGERPRINTS to {made}"
    assert made.keys() == FINGERPRINTS.keys(), advice
    for name, numbers in made.items():
        assert numbers == pytest.approx(FINGERPRINTS[name], abs=1e-3), advice


def test_humans_are_cached_and_found_by_content(cache: Path, figure: Path, tmp_path: Path) -> None:
    first = load_human(figure)
    (file,) = cache.glob("*.npz")
    before = file.stat().st_ino
    again = load_human(figure)
    np.testing.assert_array_equal(first.mesh.vertices, again.mesh.vertices)
    assert [path.stat().st_ino for path in cache.glob("*.npz")] == [before]
    # other content under the same name
    document, binary = figures.gltf()
    document["nodes"].append({"name": "armature", "scale": [0.9, 0.9, 0.9], "children": [0]})
    figure.write_bytes(figures.glb(document, binary))
    assert np.ptp(load_human(figure).mesh.vertices[:, 1]) == pytest.approx(
        0.9 * np.ptp(first.mesh.vertices[:, 1]), rel=1e-4
    )
    assert len(list(cache.glob("*.npz"))) == 2


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_a_truncated_cache_file_is_made_again(cache: Path, figure: Path, share: float) -> None:
    first = load_human(figure)
    (file,) = cache.glob("*.npz")
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    np.testing.assert_array_equal(load_human(figure).mesh.vertices, first.mesh.vertices)
    assert file.read_bytes() == content


def test_a_crash_while_writing_leaves_no_file(
    cache: Path, figure: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def crash(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("numpy.lib.format.write_array", crash)
        with pytest.raises(KeyboardInterrupt):
            load_human(figure)
    assert list(cache.glob("*.npz")) == []
    assert len(load_human(figure).mesh.vertices) == len(figures.boxes()[0])


def test_humans_load_without_write_access_to_the_cache(
    figure: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("HUMANSIM_CACHE", str(tmp_path / "file"))
    with pytest.warns(HumansimWarning, match=r"file: humans cannot be cached here .*HUMANSIM_CACHE"):
        assert len(load_human(figure).mesh.vertices) == len(figures.boxes()[0])


def arrays_of(human: Human) -> list[Any]:
    shapes = human.shapes
    return [
        *(human.mesh.vertices, human.skeleton.heads, human.weights.data, human.weights.indices),
        *(() if shapes is None else (shapes.rows, shapes.offsets)),
    ]


@pytest.mark.parametrize("kind", ["figure", pytest.param("person", marks=pytest.mark.nightly)])
def test_humans_are_the_same_to_the_bit_without_a_cache(
    kind: str, cache: Path, figure: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that has no cache plays the same person as the others."""
    body = "person#7-1" if kind == "person" else str(figure)
    made, read = load_human(body), load_human(body)
    assert len(list(cache.glob("*.npz"))) == 1
    monkeypatch.setenv("HUMANSIM_CACHE", "off")
    uncached = load_human(body)
    monkeypatch.setenv("HUMANSIM_CACHE", str(figure / "cache"))
    with pytest.warns(HumansimWarning, match="cannot be cached"):
        unwritten = load_human(body)
    for human in (read, uncached, unwritten):
        assert human.name == made.name
        for one, other in zip(arrays_of(human), arrays_of(made), strict=True):
            np.testing.assert_array_equal(one, other)


def test_processes_that_start_together_make_a_human_once(cache: Path, tmp_path: Path) -> None:
    """The others wait for it, and read it."""
    program = tmp_path / "program.py"
    program.write_text(
        "import sys, time\n"
        "from humansim_ros.people.loading.loading import cached, load_human\n"
        "def make():\n"
        "    print('made', flush=True)\n"
        "    time.sleep(2)\n"
        "    return load_human('child')\n"
        "print('ready', flush=True)\n"
        "sys.stdin.readline()\n"
        "print(len(cached('key', 'someone', make).mesh.vertices))\n"
    )
    command = [sys.executable, str(program)]
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with ExitStack() as stack:
        started: list[Any] = [stack.enter_context(subprocess.Popen(command, **pipes)) for _ in range(3)]
        assert [each.stdout.readline() for each in started] == ["ready\n"] * 3
        for each in started:
            each.stdin.write("\n")
            each.stdin.flush()
        printed = [each.communicate()[0].split() for each in started]
    assert sum(words.count("made") for words in printed) == 1
    assert len({words[-1] for words in printed}) == 1
    assert [path.name for path in cache.iterdir()] == ["someone-key.npz"]


def test_the_cache_has_a_maximum_size(
    cache: Path, figure: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("humansim_ros.people.loading.loading.MAX_HUMANS", 2)
    monkeypatch.setattr("humansim_ros.people.loading.loading.MAX_IN_USE", 4)

    def made(numbers: Sequence[int]) -> set[Path]:
        before = set(cache.glob("*.npz"))
        for number in numbers:
            (tmp_path / "someone.yaml").write_text(f"mesh: figure.glb\nstature: {1 + number / 10}\n")
            load_human(tmp_path / "someone.yaml")
        return set(cache.glob("*.npz")) - before

    # those that were used lately, such as the pool of a recipe, are not made again
    pool = made(range(4))
    assert len(pool) == 4 and not made([0, 1, 2, 3, 0])
    made([4, 5])
    assert len(list(cache.glob("*.npz"))) == 4
    # others are deleted but for the last
    for file in cache.glob("*.npz"):
        os.utime(file, (0, 0))
    assert len(made([6])) == 1 and len(list(cache.glob("*.npz"))) == 2


def test_a_human_that_another_process_deletes_meanwhile_is_no_warning(
    cache: Path, figure: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would be a finding of a recipe that must be clean, in some runs only."""
    glob = Path.glob

    def listed(self: Path, pattern: str) -> Iterator[Path]:
        return iter([*glob(self, pattern), self / "gone.npz"])

    monkeypatch.setattr(Path, "glob", listed)
    with warnings.catch_warnings():
        warnings.simplefilter("error", HumansimWarning)
        load_human(figure)
