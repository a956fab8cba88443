"""Files that requests over the network may name, and the time that a request may take."""

from __future__ import annotations

import os
import shutil
import threading
from pathlib import Path

import pytest
from conftest import ROOT
from waiting import PATIENCE, wait_until

from humansim_ros.errors import HumansimWarning, MotionError, RosError
from humansim_ros.ros.playing.motions import MAX_BYTES, BackgroundWork, RequestedMotions
from humansim_ros.scene.core.source import SceneSource

WALK = ROOT / "assets" / "motions" / "walk.bvh"


@pytest.fixture
def requests(tmp_path: Path) -> RequestedMotions:
    """Requests for a scene with a folder of motions, beside a file that they may not name."""
    for folder in ("scene/sub", "mocap", "elsewhere"):
        (tmp_path / folder).mkdir(parents=True)
        shutil.copy(WALK, tmp_path / folder / "walk_copy.bvh")
    (tmp_path / "elsewhere" / "secret.bvh").write_text("secret of somebody\n")
    (tmp_path / "scene" / "out.bvh").symlink_to(tmp_path / "elsewhere" / "secret.bvh")
    (tmp_path / "scene" / "broken.bvh").symlink_to(tmp_path / "elsewhere" / "missing.bvh")
    (tmp_path / "scene" / "out").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "scene" / "in.bvh").symlink_to(tmp_path / "mocap" / "walk_copy.bvh")
    (tmp_path / "scene" / "scene.yaml").touch()
    named = {str(tmp_path / "elsewhere" / "walk_copy.bvh")}
    return RequestedMotions.of(SceneSource.of_file(tmp_path / "scene" / "scene.yaml"), ["../mocap"], named)


def refusal(requests: RequestedMotions, name: str) -> str:
    with pytest.raises(MotionError) as caught:
        requests.motion(name, "auto")
    assert caught.value.path is caught.value.line is None
    return caught.value.message


@pytest.mark.parametrize(
    "name",
    [
        *("walk", "live", "sub/walk_copy.bvh", "{root}/scene/sub/walk_copy.bvh", "sub/../sub/walk_copy.bvh"),
        *(
            "in.bvh",
            "activity#3,standing,10",
            "../mocap/walk_copy.bvh",
            "{root}/mocap/walk_copy.bvh",
            "{root}/elsewhere/walk_copy.bvh",
        ),
    ],
)
def test_built_in_motions_and_files_of_the_folders_are_read(
    requests: RequestedMotions, name: str, tmp_path: Path
) -> None:
    """Links are followed if they lead into one of the folders; a file that the scene names is read, too."""
    assert requests.motion(name.format(root=tmp_path), "auto").n_joints > 10


@pytest.mark.parametrize(
    "name",
    [
        *("/etc/shadow", "/etc/no_such_file", "/", "", "/dev/zero", "/proc/self/environ", "../elsewhere"),
        *("{root}/elsewhere/secret.bvh", "{root}/elsewhere/missing.bvh", "{root}/elsewhere/secret.glb#Walk"),
        *("../elsewhere/secret.bvh", "sub/../../elsewhere/secret.bvh", "missing/../../elsewhere/secret.bvh"),
        *("out.bvh", "broken.bvh", "out/secret.bvh", "out/missing.bvh", "out/walk_copy.bvh"),
        *("~root/x.bvh", "~nobody_of_this_name/x.bvh", "a\0b.bvh", "../" + 1000 * "x", "{root}/scenery"),
    ],
)
def test_other_files_are_refused_whether_they_exist_or_not(
    requests: RequestedMotions, name: str, tmp_path: Path
) -> None:
    """In the same words, which name the rule and the parameter."""
    said = refusal(requests, name.format(root=tmp_path))
    if name == "":
        assert "folder" in said or "regular" in said
        return
    assert said == (
        "requests name built-in motions, and files below the folder of the scene or below folders of the "
        "parameter motion_folders, which is set at the start"
    )


def test_the_way_to_a_missing_file_tells_nothing_of_other_folders(
    requests: RequestedMotions, tmp_path: Path
) -> None:
    """Of no folder through which the path goes back and forth."""
    texts = {
        refusal(requests, f"{tmp_path}/{folder}/../scene/missing.bvh")
        for folder in ("elsewhere", "elsewher", "no_such_folder")
    }
    assert texts == {refusal(requests, f"{tmp_path}/scene/missing.bvh")}
    assert "walk_copy.bvh" in refusal(requests, "sub/walk_cpy.bvh")  # within the folders it helps


@pytest.mark.parametrize(
    "content",
    [
        *(b"secret:x:0:0\n", b"HIERARCHY\nsecret\n", b"HIERARCHY\nROOT secret\n{\nOFFSET secret 0 0\n}\n"),
        WALK.read_bytes().replace(b"Frame Time:", b"secret"),
        WALK.read_bytes().replace(b"Hips", b"secret").replace(b"OFFSET", b"secret"),
    ],
)
@pytest.mark.parametrize("suffix", [".bvh", ".gltf", ".txt"])
def test_the_content_of_a_file_that_is_no_motion_is_told_on_this_machine_only(
    requests: RequestedMotions, content: bytes, suffix: str, tmp_path: Path
) -> None:
    path = tmp_path / "scene" / f"notes{suffix}"
    path.write_bytes(content)
    with pytest.warns(HumansimWarning) as shown:
        said = refusal(requests, path.name)
    assert str(shown[-1].message).startswith(str(path))
    assert said == (
        f"{path.name!r} is not a motion that can be read; "
        "the reason is shown on the machine of the motion player"
    )


def test_only_regular_files_of_a_size_that_is_read_quickly_are_opened(
    requests: RequestedMotions, tmp_path: Path
) -> None:
    folder = tmp_path / "scene"
    os.mkfifo(folder / "pipe.bvh")
    (folder / "large.glb").touch()
    os.truncate(folder / "large.glb", MAX_BYTES + 1)
    assert refusal(requests, "pipe.bvh") == "'pipe.bvh' is not a regular file"
    assert refusal(requests, "sub") == "'sub' is not a regular file"
    assert refusal(requests, "large.glb") == "'large.glb' is too large for a request: 64 MB; at most 64 MB"


def test_folders_of_requests_exist(tmp_path: Path) -> None:
    with pytest.raises(MotionError, match=r"motion_folders: '.*missing' is not a folder"):
        RequestedMotions.of(SceneSource(folder=tmp_path), ["missing"], ())


def test_work_in_the_background_gives_its_result_or_its_error() -> None:
    work, ticks = BackgroundWork(PATIENCE), list[int]()
    ready = threading.Event()

    def tick() -> None:
        ticks.append(1)
        if len(ticks) == 3:
            ready.set()

    assert work.run(lambda: ready.wait(PATIENCE), tick, 0.001)
    assert len(ticks) >= 3
    with pytest.raises(ZeroDivisionError):
        work.run(lambda: 1 // 0, tick, 0.001)


def test_work_that_takes_too_long_is_given_up_and_nothing_else_starts_before_its_end() -> None:
    work = BackgroundWork(0.05)
    end, ended = threading.Event(), threading.Event()

    def hang() -> None:
        end.wait(PATIENCE)
        ended.set()

    with pytest.raises(RosError, match=r"takes more than 0\.05 s"):
        work.run(hang, lambda: None, 0.001)
    with pytest.raises(RosError, match="has not ended yet"):
        work.run(hang, lambda: None, 0.001)
    end.set()
    assert ended.wait(PATIENCE)
    assert wait_until(lambda: not work.is_busy)
    work.run(lambda: None, lambda: None, 0.001)


class SlowToEnd(threading.Thread):
    """A thread that lives on after its work, as on a busy machine."""

    def run(self) -> None:
        super().run()
        threading.Event().wait(0.05)


def test_work_can_begin_as_soon_as_the_earlier_work_has_returned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, "Thread", SlowToEnd)
    work = BackgroundWork(PATIENCE)
    assert [work.run(lambda number=number: number, lambda: None, 0.0) for number in range(5)] == list(
        range(5)
    )
