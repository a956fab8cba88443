"""The tab Human: from a mesh to a person of the scene, with joints that are moved, and what is refused."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from commands import humansim
from mesh_files import MESHES, mesh_path
from pages import told_app
from waiting import wait_until

pytest.importorskip("viser")

from humansim_ros import load_human
from humansim_ros.errors import HumansimError
from humansim_ros.geometry import WORLD_FROM_BODY
from humansim_ros.view.edit.person_draft import PersonDraft
from humansim_ros.view.panels import drawn_person
from humansim_ros.view.panels.human import HumanPanel
from humansim_ros.view.sources.inputs import new_scene

PERSON = "own_male_T_uv_m.obj"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("scene")
    shutil.copy(mesh_path(PERSON), made / "person.obj")
    return made


@pytest.fixture(scope="module")
def draft(folder: Path) -> PersonDraft:
    return PersonDraft.of(folder, {"mesh": "person.obj"})


@pytest.mark.nightly
def test_the_joints_of_a_mesh_are_near_the_true_ones(draft: PersonDraft) -> None:
    true = MESHES[PERSON].joints
    shift = draft.mesh.vertices.min(0) - MESHES[PERSON].vertices.min(0)
    for joint in ("l_elbow", "r_knee", "l_hip", "vt3"):
        assert np.linalg.norm(draft.joints[joint] - true[joint] - shift) < 0.06, joint


def test_a_moved_joint_is_in_the_skeleton_on_both_sides_and_can_be_taken_back(draft: PersonDraft) -> None:
    place = draft.joints["l_elbow"] + [0.02, 0.01, 0.0]
    moved = draft.moved("l_elbow", place)
    np.testing.assert_allclose(moved.joints["l_elbow"], place, atol=1e-4)
    np.testing.assert_allclose(moved.joints["r_elbow"], place * [-1, 1, 1], atol=1e-4)
    bone = moved.skeleton.bone("l_shoulder")
    np.testing.assert_allclose(moved.skeleton.tails[bone], place, atol=1e-4)
    assert set(moved.settings.joints) == {"l_elbow", "r_elbow"}
    one = moved.moved("l_elbow", place + 0.01, both=False)
    np.testing.assert_allclose(one.joints["r_elbow"], place * [-1, 1, 1], atol=1e-4)
    np.testing.assert_allclose(moved.moved("vt3", [0.3, 1.5, 0.0]).joints["vt3"], [0, 1.5, 0])
    np.testing.assert_allclose(one.undone().joints["l_elbow"], place, atol=1e-4)
    first = one.undone().undone()
    np.testing.assert_allclose(first.joints["l_elbow"], draft.joints["l_elbow"], atol=1e-9)
    assert first.undone() is first


@pytest.mark.parametrize("place", [[np.nan, 0, 0], [0, 0, 1e6], [0, 0]])
def test_a_joint_is_not_placed_nowhere(draft: PersonDraft, place: list[float]) -> None:
    with pytest.raises(HumansimError, match="three numbers"):
        draft.moved("l_elbow", np.array(place))
    with pytest.raises(HumansimError, match="no joint"):
        draft.moved("l_tail", np.zeros(3))


@pytest.mark.nightly
@pytest.mark.slow
def test_a_written_person_equals_the_person_of_the_command_and_shows_its_weights(
    draft: PersonDraft, folder: Path
) -> None:
    with pytest.raises(HumansimError, match="weights first"):
        draft.write("anna")
    with pytest.raises(HumansimError, match="weights first"):
        draft.weight_colors()
    place = draft.joints["l_elbow"] + [0.03, 0.0, 0.0]
    rigged = draft.moved("l_elbow", place).rigged(rigging="thesis")
    for wrong in ("../anna", "", "two words", "a" * 200):
        with pytest.raises(HumansimError):
            rigged.write(wrong)
    assert rigged.write("anna") == "anna.npz"
    np.testing.assert_allclose(
        load_human(folder / "anna.npz").skeleton.heads[draft.skeleton.bone("l_elbow")], place, atol=1e-3
    )
    assert rigged.command("anna") == "humansim human build anna.yaml -o anna.npz"
    assert humansim("human", "build", folder / "anna.yaml", "-o", folder / "again.npz").returncode == 0
    assert (folder / "again.npz").read_bytes() == (folder / "anna.npz").read_bytes()
    assert rigged.write("anna") == "anna.npz"  # its own file
    (folder / "ben.npz").write_bytes(b"of someone else")
    with pytest.raises(HumansimError, match=r"ben\.npz exists already"):
        rigged.write("ben")
    colors = rigged.weight_colors("l_elbow")
    left = rigged.mesh.vertices[:, 0] > place[0] + 0.05
    right = rigged.mesh.vertices[:, 0] < 0
    assert colors[left][:, 1].min() < 60 and (colors[right] == 225).all()
    with pytest.raises(HumansimError):
        rigged.weight_colors("tail")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n",
            "person|symmetr|axes|head",
        ),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "flat"),
        ("v 0 0\nf 1 1 1\n", ":1"),
        ("nothing\n", "obj|face|vert|OBJ"),
    ],
)
def test_a_mesh_that_is_no_person_is_refused_with_the_reason(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "thing.obj").write_text(text)
    with pytest.raises(HumansimError, match=reason):
        PersonDraft.of(tmp_path, {"mesh": "thing.obj"})


def test_wrong_settings_and_files_elsewhere_are_refused(folder: Path) -> None:
    with pytest.raises(HumansimError, match="stature"):
        PersonDraft.of(folder, {"mesh": "person.obj", "stature": 50})
    with pytest.raises(HumansimError, match="below"):
        PersonDraft.of(folder, {"mesh": "../person.obj"})
    with pytest.raises(HumansimError, match="l_elbow"):
        PersonDraft.of(folder, {"mesh": "person.obj", "joints": {"l_elbo": [0, 1, 0]}})


def test_a_figure_keeps_its_own_joints_and_weights(tmp_path: Path) -> None:
    shutil.copy(mesh_path("own_figure.glb"), tmp_path / "figure.glb")
    draft = PersonDraft.of(tmp_path, {"mesh": "figure.glb"})
    assert draft.figure and draft.joints == {} and draft.human is not None
    with pytest.raises(HumansimError, match="its own joints"):
        draft.moved("l_elbow", np.zeros(3))


# --- the panel


class Panel:
    """The tab of a page of a new scene, whose thread is this one."""

    def __init__(self, folder: Path) -> None:
        opened = new_scene(folder)
        self.app, self.told = told_app(opened)
        assert self.app.human is not None and opened.document is not None
        self.human: HumanPanel = self.app.human
        self.document = opened.document

    def wait(self) -> None:
        """Until the step has ended, as the loop of the page does it."""

        def ended() -> bool:
            self.app._run_posted()
            return not self.human._background.works

        assert wait_until(ended)

    def node(self, name: str) -> Any:
        return self.app.server.viser.scene._handle_from_node_name.get(name)


@pytest.fixture
def panel(folder: Path) -> Iterator[Panel]:
    made = Panel(folder)
    yield made
    made.app.close()


def drag(panel: Panel, joint: str, by: list[float]) -> None:
    """What viser calls while a joint is dragged from a point on its surface."""
    sphere = panel.node(f"/human/joints/{joint}")
    start = np.add(sphere.position, [0.01, 0, 0])
    (entry,) = sphere._impl.drag_cb
    for phase, share in (("start", 0.0), ("update", 0.5), ("end", 1.0)):
        entry.callback(
            SimpleNamespace(
                phase=phase,
                target=sphere,
                start_position=tuple(start),
                end_position=tuple(start + share * np.array(by)),
            )
        )
        panel.app._run_posted()
        sphere = panel.node(f"/human/joints/{joint}")


@pytest.mark.nightly
@pytest.mark.slow
def test_a_mesh_becomes_a_person_of_the_scene_with_a_joint_that_was_dragged(panel: Panel) -> None:
    human = panel.human
    human.mesh.take("person.obj")
    assert not human._background.works or panel.human._bar.visible
    panel.wait()
    assert human.draft is not None and "drag the yellow joints" in human._state.content
    before = human.draft.joints["l_knee"]
    np.testing.assert_allclose(
        panel.node("/human/joints/l_knee").position, WORLD_FROM_BODY @ before, atol=1e-6
    )
    drag(panel, "l_knee", [0.04, 0.0, 0.02])  # forward and up in map
    np.testing.assert_allclose(human.draft.joints["l_knee"], np.add(before, [0, 0.02, 0.04]), atol=1e-3)
    assert len(human.draft.before) == 1  # one step of the whole drag
    assert "l_knee" in human._same.content and "humansim human build" in human._same.content
    np.testing.assert_allclose(human._place.value, human.draft.joints["l_knee"], atol=1e-3)
    human.rig()
    panel.wait()
    assert human._shown.value == "weights of all bones" and panel.node("/human/joints/l_knee") is None
    human._name.value = "carla"
    human.add()
    panel.wait()
    assert panel.document.value("humans.carla.body") == "carla.npz"
    assert panel.document.command() == "humansim human build carla.yaml -o carla.npz"
    assert list(panel.app.source.people) == ["carla"]
    assert panel.node("/human/body") is None


def test_a_file_that_is_no_person_is_told_and_the_tab_goes_on(panel: Panel) -> None:
    (panel.document.folder / "box.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    panel.human.mesh.take("box.obj")
    panel.wait()
    assert "flat" in panel.human._state.content and "flat" in panel.told[-1]
    assert panel.human.draft is None
    for action in (panel.human.rig, panel.human.add):
        with pytest.raises(HumansimError, match="choose a mesh first"):
            action()
    assert threading.active_count() < 60


# --- a person by seed


def test_sliders_make_the_person_of_the_command_and_replace_it(
    panel: Panel, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn, folder = panel.human.drawn, panel.document.folder
    text = drawn._state.content
    drawn.set("age", 70.0)
    drawn.set("sex", "female")
    drawn.set("height", 1.58)
    drawn.set("hair", "bun")
    drawn.set("wears", "glasses, bag")
    assert drawn._state.content != text and "female, 70 years, 1.58 m" in drawn._state.content
    person = drawn.person()
    assert drawn.sliders["weight"].value == pytest.approx(person.weight, abs=0.25)  # as drawn
    drawn._name.value = "grandma"
    drawn.show()
    command = (
        "humansim human make --seed 1 --age 70 --sex female --height 1.58 --hair bun --wears glasses,bag "
        "-o grandma.npz"
    )
    assert drawn.command() == command and command in drawn._same.content
    drawn.add()
    panel.wait()
    assert panel.document.value("humans.grandma.body") == "grandma.npz"
    assert np.ptp(load_human(folder / "grandma.npz").mesh.vertices[:, 1]) == pytest.approx(1.6, abs=0.05)
    made = (folder / "grandma.npz").read_bytes()
    drawn.set("height", 1.5)
    built, child = [], load_human("child")  # which takes no time
    monkeypatch.setattr(drawn_person, "make_person", lambda person, _: built.append(person) or child)
    drawn.add()
    panel.wait()
    assert [person.stature for person in built] == [1.5]
    assert (folder / "grandma.npz").read_bytes() != made
    shown = panel.app.source.people["grandma"]
    assert np.ptp(shown.mesh.vertices[:, 1]) == pytest.approx(np.ptp(child.mesh.vertices[:, 1]), abs=1e-6)
    drawn.reset()
    assert drawn._state.content == text


def test_a_person_whom_nobody_is_and_the_file_of_another_are_refused(panel: Panel) -> None:
    drawn, folder = panel.human.drawn, panel.document.folder
    drawn.set("age", 30.0)
    drawn.set("height", 0.8)
    assert "⚠" in drawn._state.content and "metres at 30 years" in drawn._state.content
    with pytest.raises(HumansimError, match=r"height: .*1\.\d+ to "):
        drawn.add()
    assert drawn._add.disabled
    drawn.set("height", 1.8)
    assert not drawn._add.disabled
    drawn.set("wears", "wings")
    assert "wings" in drawn._state.content
    drawn.set("wears", "")
    (folder / "taken.npz").write_bytes(b"of another")
    for name, message in (("taken", "exists already"), ("../up", "name")):
        drawn._name.value = name
        with pytest.raises(HumansimError, match=message):
            drawn.add()
    assert (folder / "taken.npz").read_bytes() == b"of another"
