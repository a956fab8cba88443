"""Files that browsers send: what is kept beside the scene, and everything that is refused."""

from __future__ import annotations

import http.client
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT
from pages import told_app
from waiting import wait_until

pytest.importorskip("viser")

from motion_files import stand_in, walk
from motion_formats import write_acclaim
from msgspec.msgpack import encode
from test_server import CAMERA, connected, get

from humansim_ros.errors import HumansimError
from humansim_ros.motion.files.motion_formats import MOTION_SUFFIXES
from humansim_ros.view.server.server import MOST_UPLOAD, PART, PageServer, UploadGate
from humansim_ros.view.server.uploads import KINDS, files_in, keep_file, kind_of_key, plain_name
from humansim_ros.view.sources.inputs import new_scene, open_source

WALK = (ROOT / "assets/motions/walk.bvh").read_bytes()


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


# --- names and kinds


@pytest.mark.parametrize(
    ("name", "kept"),
    [
        ("walk.bvh", "walk.bvh"),
        ("../../etc/cron.d/walk.bvh", "walk.bvh"),
        ("C:\\Users\\me\\Walk One.BVH", "Walk_One.bvh"),
        (".bashrc.bvh", "bashrc.bvh"),
        ("a\0b\n\u202ecod.bvh", "a_b_cod.bvh"),
        ("-rf; rm $HOME.bvh", "rf_rm_HOME.bvh"),
        ("Größe.bvh", "Groe.bvh"),
        ("歩く.bvh", "file.bvh"),
        ("x" * 500 + ".bvh", "x" * 80 + ".bvh"),
    ],
)
def test_names_of_files_are_made_plain(name: str, kept: str) -> None:
    assert plain_name(name, (".bvh",)) == kept


@pytest.mark.parametrize("name", ["walk.exe", "walk", "walk.bvh/..", "walk.bvh.html", "", "walk.bvh\0.sh"])
def test_files_with_another_suffix_are_refused_with_the_suffixes_that_are_taken(name: str) -> None:
    with pytest.raises(HumansimError, match=r"\.bvh"):
        plain_name(name, (".bvh",))


def test_a_motion_is_kept_beside_the_scene_and_offered(tmp_path: Path) -> None:
    folder = tmp_path / "new"
    path = keep_file(folder, "../My Walk.bvh", WALK, "motion")
    assert path == folder / "My_Walk.bvh" and path.read_bytes() == WALK
    assert files_in(folder, "motion") == ["My_Walk.bvh"] and files_in(folder, "image") == []
    assert keep_file(folder, "My Walk.bvh", WALK, "motion") == path  # the same content
    other = keep_file(folder, "My Walk.bvh", WALK + b"\n", "motion")
    assert other.name == "My_Walk_2.bvh" and path.read_bytes() == WALK
    assert names(folder) == ["My_Walk.bvh", "My_Walk_2.bvh"]


def test_an_amc_motion_is_kept_after_its_skeleton(tmp_path: Path) -> None:
    amc = write_acclaim(tmp_path, stand_in("cmu_asf"), walk(3))
    folder = tmp_path / "scene"
    with pytest.raises(HumansimError, match=r"its skeleton is missing: put .* beside it"):
        keep_file(folder, "walk.amc", amc.read_bytes(), "motion")
    keep_file(folder, "walk.asf", amc.with_suffix(".asf").read_bytes(), "companion")
    keep_file(folder, "other.asf", amc.with_suffix(".asf").read_bytes(), "companion")
    keep_file(folder, "walk.amc", amc.read_bytes(), "motion")
    assert files_in(folder, "motion") == ["walk.amc"]


def test_motions_of_all_formats_are_taken() -> None:
    assert {*KINDS["motion"].suffixes, ".asf"} == set(MOTION_SUFFIXES)


@pytest.mark.parametrize(
    ("name", "kind", "content", "reason"),
    [
        ("walk.bvh", "motion", b"\x89PNG\r\n\x1a\n", "is not a motion of a person"),
        ("walk.bvh", "motion", b"HIERARCHY\n", "is not a motion of a person"),
        ("person.obj", "body", b"v 0 0\nf 1 2 3\n", "is not a mesh of a person"),
        ("lab.toml", "calibration", b"[a]\nb = 1\n", "is not a calibration"),
        ("photo.png", "image", b"GIF89a", "is not an image"),
        ("keys.xml", "keyframes", b"<!DOCTYPE x [<!ENTITY a 'b'>]><x>&a;</x>", "is not a keyframe file"),
        ("walk.bvh", "motion", b"", "1 B"),
    ],
)
def test_a_file_of_another_kind_is_refused_and_leaves_nothing(
    tmp_path: Path, name: str, kind: str, content: bytes, reason: str
) -> None:
    with pytest.raises(HumansimError, match=reason) as caught:
        keep_file(tmp_path, name, content, kind)
    assert name in str(caught.value) and str(tmp_path) not in str(caught.value)
    assert names(tmp_path) == []


def test_a_description_that_names_files_elsewhere_is_refused(tmp_path: Path) -> None:
    with pytest.raises(HumansimError, match="below"):
        keep_file(tmp_path, "person.yaml", b"mesh: /etc/passwd\n", "body")


def test_a_link_to_another_place_is_neither_written_through_nor_offered(tmp_path: Path) -> None:
    outside = tmp_path / "outside.bvh"
    outside.write_bytes(WALK)
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "walk.bvh").symlink_to(outside)
    assert keep_file(folder, "walk.bvh", WALK + b"\n", "motion").name == "walk_2.bvh"
    assert outside.read_bytes() == WALK
    assert files_in(folder, "motion") == ["walk_2.bvh"]


def test_every_file_key_of_scenes_has_a_kind() -> None:
    for keys in (
        ("humans", "anna", "body"),
        ("humans", "anna", "motion", "file"),
        ("humans", "anna", "motion", "joint_names"),
        ("humans", "anna", "keyframes", "file"),
        ("objects", "box", "mesh"),
        ("objects", "box", "keyframes", "file"),
        ("cameras", "left", "calibration"),
        ("cameras", "left", "trajectory", "file"),
        ("cameras", "left", "background"),
        ("rig", "file"),
        ("world", "environment"),
    ):
        assert kind_of_key(keys) in KINDS, keys
    assert kind_of_key(("humans", "anna", "outfit")) is None


# --- while they arrive


def begin(
    transfer: str = "a", size: int = PART + 10, parts: int = 2, name: str = "walk.bvh"
) -> dict[str, Any]:
    return {
        "type": "FileTransferStartUpload",
        "source_component_uuid": "button",
        "transfer_uuid": transfer,
        "filename": name,
        "mime_type": "",
        "part_count": parts,
        "size_bytes": size,
    }


def part(index: int, content: object = b"x", transfer: str = "a") -> dict[str, Any]:
    return {
        "type": "FileTransferPart",
        "source_component_uuid": "button",
        "transfer_uuid": transfer,
        "part_index": index,
        "content": content,
    }


def test_only_parts_of_an_announced_file_are_taken_each_once() -> None:
    told: list[str] = []
    on_the_way: dict[str, int] = {}
    gate = UploadGate(told.append, on_the_way)
    assert not gate.takes(part(0))
    assert gate.takes(begin())
    assert not gate.takes(begin())
    for wrong in (part(2), part(-1), part(0, "text"), part(0, b"x" * (PART + 1)), part(0, transfer="b")):
        assert not gate.takes(wrong)
    assert gate.takes(part(0)) and not gate.takes(part(0)) and gate.takes(part(1))
    assert on_the_way == {} and told == []
    assert not gate.takes(part(1))


def test_files_that_are_too_large_empty_or_lie_about_their_size_are_refused() -> None:
    told: list[str] = []
    gate = UploadGate(told.append, {})
    assert not gate.takes(begin(size=MOST_UPLOAD + 1, parts=MOST_UPLOAD // PART + 1))
    assert "at most" in told[-1] and "walk.bvh" in told[-1]
    assert not gate.takes(begin(size=0, parts=0)) and "empty" in told[-1]
    for wrong in ({"size": 10, "parts": 2}, {"size": -1, "parts": 0}, {"size": 10, "parts": 10**9}):
        assert not gate.takes(begin(**wrong))  # type: ignore[arg-type]


def test_many_files_at_once_do_not_fill_the_memory_and_end_with_their_browser() -> None:
    told: list[str] = []
    on_the_way: dict[str, int] = {}
    gates = [UploadGate(told.append, on_the_way) for _ in range(3)]
    whole = {"size": MOST_UPLOAD, "parts": MOST_UPLOAD // PART}
    assert gates[0].takes(begin("a", **whole)) and gates[1].takes(begin("b", **whole))
    assert not gates[2].takes(begin("c", **whole)) and "a moment" in told[-1]
    gates[0].close()
    assert gates[2].takes(begin("c", **whole))


# --- through the page


class Uploads:
    """A page of a new scene without a browser; its thread runs."""

    def __init__(self, folder: Path) -> None:
        opened = new_scene(folder)
        self.folder = folder
        self.app, self.told = told_app(opened)
        self.thread = threading.Thread(target=self.app.run)
        self.thread.start()

    def button(self, label: str) -> str | None:
        """uuid of an upload button; None while there is none."""
        handles = list(self.app.gui._gui_input_handle_from_uuid.values())
        return next((h._impl.uuid for h in handles if getattr(h, "label", "") == label), None)


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Uploads]:
    made = Uploads(tmp_path / "new" / "scene")
    yield made
    made.app.stop()
    made.thread.join()
    made.app.close()


@pytest.mark.nightly
def test_a_new_folder_is_an_empty_scene_that_shows_people_before_it_has_cameras(page: Uploads) -> None:
    app = page.app
    assert app.editor is not None
    assert not page.folder.exists()
    assert app.source.cameras == {} and app.source.people == {}
    done = threading.Event()

    def build() -> None:
        assert app.editor is not None
        app.editor.add("humans")
        assert list(app.source.people) == ["person"] and app.source.cameras == {}
        app.editor.add("cameras")
        assert list(app.source.cameras) == ["camera_1"] and app.editor.document.errors() == []
        page.folder.mkdir(parents=True)
        app.editor.save("scene.yaml")
        done.set()

    app.post(build)
    assert wait_until(done.is_set)
    assert (page.folder / "scene.yaml").is_file()
    opened = open_source(page.folder)
    assert opened.path == page.folder / "scene.yaml"
    opened.source.close()


@pytest.mark.nightly
def test_a_file_of_a_browser_becomes_the_value_of_its_key(page: Uploads) -> None:
    app = page.app
    assert app.editor is not None
    editor = app.editor
    app.post(lambda: editor.add("humans"))
    assert wait_until(lambda: page.button("Upload file …") is not None)
    uuid = page.button("Upload file …")
    content = WALK + b"\n" * PART
    with connected(app.server, max_size=None) as browser:
        browser.send(encode(CAMERA))
        for message in (
            begin(size=len(content), name="../../walk of mine.bvh"),
            part(0, content[:PART]),
            part(1, content[PART:]),
        ):
            browser.send(encode(message | {"source_component_uuid": uuid}))
        assert wait_until(lambda: editor.document.value("humans.person.motion.file") == "walk_of_mine.bvh")
        assert (page.folder / "walk_of_mine.bvh").read_bytes() == content
        assert not (page.folder.parent.parent / "walk of mine.bvh").exists()
        wrong = b"not a motion"
        for message in (begin("b", len(wrong), 1, "evil.bvh"), part(0, wrong, "b")):
            browser.send(encode(message | {"source_component_uuid": uuid}))
        assert wait_until(lambda: any("evil.bvh is not a motion" in text for text in page.told))
        browser.send(encode(begin("c", MOST_UPLOAD + 1, MOST_UPLOAD // PART + 1)))
        assert wait_until(lambda: any("at most" in text for text in page.told))
    assert names(page.folder) == ["walk_of_mine.bvh"]
    get(app.server, "/humansim/refused?name=%1b%5b2Jx.obj&size=99999999999")
    assert wait_until(lambda: any("x.obj" in text and "at most" in text for text in page.told))
    assert not any("\x1b" in text for text in page.told)


def test_a_folder_with_several_scenes_or_a_file_in_its_place_is_told(tmp_path: Path) -> None:
    for name in ("a.yaml", "b.yaml"):
        (tmp_path / name).write_text("humans: {}\ncameras: {}\n")
    with pytest.raises(HumansimError, match=r"several scenes: give one of a\.yaml, b\.yaml"):
        open_source(tmp_path)
    with pytest.raises(HumansimError, match="this is a file"):
        new_scene(tmp_path / "a.yaml")


# --- results


def test_results_are_files_that_the_page_names_and_their_scripts_are_shut_in(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("<script>alert(1)</script>")
    (tmp_path / "data.mcap").write_bytes(b"bag")
    known = {"report.html": tmp_path / "report.html", "data.mcap": tmp_path / "data.mcap"}
    server = PageServer("lab", 0)
    server.result = known.get
    try:
        for name, expected in (("report.html", None), ("data.mcap", "attachment")):
            connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
            connection.request("GET", f"/humansim/results/{name}")
            answer = connection.getresponse()
            assert answer.status == 200 and answer.read() == known[name].read_bytes()
            assert "sandbox" in answer.headers["Content-Security-Policy"]
            assert "allow-same-origin" not in answer.headers["Content-Security-Policy"]
            assert (expected or "") in (answer.headers["Content-Disposition"] or "")
            connection.close()
        assert get(server, "/humansim/results/../../etc/passwd")[0] == 404
        assert get(server, "/humansim/results/none")[0] == 404
        assert get(server, "/humansim/results/report.html", Origin="http://evil.example")[0] == 403
    finally:
        server.close()
