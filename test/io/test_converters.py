"""FBX files through a converter, and programs under limits; stand-ins of Blender and FBX2glTF convert."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import figures
import numpy as np
import pytest
from waiting import has_ended, wait_until

from humansim_ros import read_motion
from humansim_ros.errors import HumansimError, MeshError, MotionError
from humansim_ros.files.mesh.load import read_mesh, read_mesh_or_figure
from humansim_ros.files.reading import programs
from humansim_ros.files.reading.programs import converted_fbx, is_fbx, run_limited
from humansim_ros.people.loading.loading import load_human

FBX = b"Kaydara FBX Binary  \x00\x1a\x00" + bytes(100)
#: It copies the .glb file beside the FBX file, and counts its starts.
COPIES = """
import pathlib, sys
source, target = {place}
with open({log!r}, "a") as log:
    log.write(" ".join(sys.argv[1:]) + chr(10))
pathlib.Path(target).write_bytes(pathlib.Path(source).with_suffix(".glb").read_bytes())
"""
Install = Callable[..., Path]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Install a stand-in of a converter as the only one, with an empty cache; returns its log."""
    monkeypatch.setenv("HUMANSIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.delenv("HUMANSIM_FBX", raising=False)
    monkeypatch.setattr(programs.importlib.util, "find_spec", lambda name: None)
    (tmp_path / "bin").mkdir()

    def install(name: str = "blender", code: str = COPIES, *, on_path: bool = True) -> Path:
        log = tmp_path / "log"
        place = (
            'sys.argv[sys.argv.index("--input") + 1], sys.argv[-1]'
            if "fbx" in name.lower()
            else "sys.argv[-3:-1]"
        )
        program = tmp_path / "bin" / name
        text = code.replace("{place}", place).replace("{log!r}", repr(str(log)))
        program.write_text(f"#!{sys.executable}\n{text}")
        program.chmod(0o755)
        if not on_path:
            monkeypatch.setenv("PATH", "")
            monkeypatch.setenv("HUMANSIM_FBX", str(program))
        return log

    return install


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """FBX file beside the glTF file that the stand-ins convert it to."""
    (tmp_path / "person.glb").write_bytes(figures.glb(*figures.gltf()))
    path = tmp_path / "person.fbx"
    path.write_bytes(FBX)
    return path


@pytest.mark.parametrize("name", ["blender", "FBX2glTF", "fbx2gltf"])
def test_an_fbx_mesh_is_what_the_converter_makes_of_it(file: Path, install: Install, name: str) -> None:
    install(name)
    figure, expected = (read_mesh_or_figure(path) for path in (file, file.with_suffix(".glb")))
    np.testing.assert_array_equal(figure.joints, expected.joints)  # type: ignore[union-attr]
    np.testing.assert_array_equal(figure.mesh.vertices, expected.mesh.vertices)  # type: ignore[union-attr]
    assert len(load_human(file).skeleton) > 20


def test_the_content_decides_that_a_file_is_fbx(file: Path, install: Install) -> None:
    install()
    other = file.with_name("person.obj")
    file.rename(other)
    assert len(read_mesh(other).vertices) == len(read_mesh(file.with_suffix(".glb")).vertices)


def test_an_fbx_animation_is_read_as_a_motion(file: Path, install: Install) -> None:
    install()
    motion, expected = read_motion(f"{file}#bend"), read_motion(f"{file.with_suffix('.glb')}#bend")
    np.testing.assert_array_equal(motion.values, expected.values)
    with pytest.raises(MotionError, match="no animation 'jump'; there are bend"):
        read_motion(f"{file}#jump")


def test_the_variable_names_the_converter_before_all_others(file: Path, install: Install) -> None:
    log = install("my_python", on_path=False)
    assert converted_fbx(file, MeshError) == file.with_suffix(".glb").read_bytes()
    script, source, _, folder = log.read_text().split()
    assert (source, folder, Path(script).name) == (str(file), str(file.parent), "convert.py")


def test_a_file_is_converted_once_until_it_or_its_textures_change(file: Path, install: Install) -> None:
    log = install()
    for _ in range(2):
        read_mesh(file)
    assert len(log.read_text().splitlines()) == 1
    (file.parent / "textures").mkdir()
    (file.parent / "textures" / "skin.png").write_bytes(b"1")
    read_mesh(file)
    file.write_bytes(FBX + b"1")
    read_mesh(file)
    assert len(log.read_text().splitlines()) == 3


def test_without_a_converter_the_line_that_converts_is_named(file: Path, install: Install) -> None:
    with pytest.raises(MeshError) as caught:
        read_mesh(file)
    for part in (
        "install Blender",
        "HUMANSIM_FBX",
        "pip install bpy",
        "blender -b",
        "person.fbx",
        "person.glb",
    ):
        assert part in str(caught.value)
    with pytest.raises(MotionError, match="install Blender"):
        read_motion(file)


@pytest.mark.parametrize(
    ("code", "message"),
    [
        (
            "import sys; sys.exit('Error: Version 1 unsupported, must be 7100 or later')",
            "must be 7100 or later",
        ),
        (
            "raise ModuleNotFoundError(\"No module named 'bpy'\")",
            "a Python without bpy; pip install bpy there",
        ),
        ("print('done')", "cannot convert it: done"),
        ("pass", "no reason given"),
        ("print('\x1b[31mred\u202e')", r"cannot convert it: \[31mred$"),
        ("import os; os.kill(os.getpid(), 9)", "stopped at 8 GB of memory or 300 s"),
        ("import sys; open(sys.argv[-2], 'w').write('x')", "not a glTF file"),
    ],
)
def test_a_converter_that_fails_is_told_with_its_reason(
    file: Path, install: Install, code: str, message: str
) -> None:
    install(code=code)
    with pytest.raises(MeshError, match=message) as caught:
        read_mesh(file)
    assert caught.value.path == str(file)


def test_a_converter_that_hangs_ends_with_its_children(
    file: Path, install: Install, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(programs, "_SECONDS", 0.5)
    pid = file.with_name("pid")
    child = f"open({str(pid)!r}, 'w').write(str(os.getpid())); time.sleep(600)"
    install(code=f"import os, time\nos.fork()\n{child}")
    with pytest.raises(MeshError, match=r"more than 0\.5 s: simplify"):
        read_mesh(file)
    killed = int(pid.read_text())
    assert wait_until(lambda: has_ended(killed))  # killed, which takes a moment on a loaded machine


@pytest.mark.parametrize(
    ("named", "message"),
    [("/no/such/python", "'/no/such/python' is not a program"), ("person.glb", "not a program")],
)
def test_a_wrong_name_of_the_converter_is_told(
    file: Path, install: Install, monkeypatch: pytest.MonkeyPatch, named: str, message: str
) -> None:
    monkeypatch.setenv("HUMANSIM_FBX", named)
    with pytest.raises(MeshError, match=message):
        read_mesh(file)


def test_files_that_are_no_fbx_are_refused_without_a_converter(tmp_path: Path, install: Install) -> None:
    path = tmp_path / "noise.fbx"
    path.write_bytes(bytes(range(1, 256)))
    for read in (read_mesh, lambda file: converted_fbx(file, MeshError)):
        with pytest.raises(MeshError, match="not an FBX file"):
            read(path)
    with pytest.raises(MeshError, match="no such FBX file"):
        converted_fbx(tmp_path / "nobody.fbx", MeshError)


def test_text_fbx_is_refused_for_blender_only(file: Path, install: Install) -> None:
    install()
    file.write_bytes(b"; FBX 7.3.0 project file\n")
    with pytest.raises(MeshError, match="an FBX text file, which Blender does not read"):
        read_mesh(file)
    (file.parent / "bin" / "blender").unlink()
    install_again = file.parent / "bin"
    shutil.rmtree(install_again)
    install_again.mkdir()
    install("FBX2glTF")
    assert read_mesh(file).vertices.shape[1] == 3


def test_a_converter_may_fail_to_be_cached(
    file: Path, install: Install, monkeypatch: pytest.MonkeyPatch
) -> None:
    install()
    (file.parent / "cache").write_text("a file where the folder should be")
    assert is_fbx(file.read_bytes())
    assert converted_fbx(file, MeshError) == file.with_suffix(".glb").read_bytes()


@pytest.mark.parametrize(
    ("code", "ends"),
    [
        ("bytes(1 << 31)", lambda done: b"MemoryError" in done.stderr),
        ("while True: pass", lambda done: done.returncode in (-24, -9)),  # SIGXCPU, SIGKILL
        ("import sys; sys.stdout.write(sys.stdin.read())", lambda done: done.stdout == b"content"),
    ],
)
def test_a_program_ends_at_its_limits(
    code: str, ends: Callable[[subprocess.CompletedProcess[bytes]], bool]
) -> None:
    command = [sys.executable, "-ISc", code]
    assert ends(run_limited(command, b"content", memory=1 << 30, cpu_seconds=1, seconds=60))


def test_a_program_that_is_missing_is_an_error_of_the_user(file: Path, install: Install) -> None:
    install(code="")
    program = file.parent / "bin" / "blender"
    program.write_text("#!/no/such/interpreter\n")
    with pytest.raises(HumansimError, match="blender cannot convert it"):
        read_mesh(file)
