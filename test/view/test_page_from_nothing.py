"""From an empty folder to a data set and an evaluation, by clicks and uploads in a headless Chromium."""

from __future__ import annotations

import csv
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from mesh_files import mesh_path
from stand_ins import STAND_INS

pytest.importorskip("viser")
pytest.importorskip("playwright")

from pages import browser, needs_browser, served, until

from humansim_ros import Scene, Simulation, load_human

pytestmark = [needs_browser, pytest.mark.nightly, pytest.mark.slow, pytest.mark.process]

PICTURES = os.environ.get("HUMANSIM_PICTURES")
FRAMES = 5
#: The error of the estimate, metres.
SHIFT = 0.02


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browser() as opened:
        yield opened


def tab(page: Any, name: str) -> None:
    page.get_by_role("tab", name=name, exact=True).click()


def upload(page: Any, button: str, file: Path) -> None:
    """Choose a file of this machine in the dialog of a button."""
    with page.expect_file_chooser() as dialog:
        page.get_by_role("button", name=button, exact=True).filter(visible=True).first.click()
    dialog.value.set_files(str(file))


def press(page: Any, button: str) -> None:
    page.get_by_role("button", name=button, exact=True).filter(visible=True).first.click()


def field(page: Any, label: str) -> Any:
    """The first visible control with a label."""
    return (
        page.locator(f"xpath=//label[normalize-space()='{label}']/following::input[1]")
        .filter(visible=True)
        .first
    )


def choose(page: Any, label: str, option: str) -> None:
    """Choose from a list."""
    field(page, label).click()
    page.get_by_role("option", name=option, exact=True).filter(visible=True).first.click()


def picture(page: Any, name: str) -> None:
    if PICTURES:
        page.add_style_tag(content=".mantine-Notifications-root { opacity: 0 }")
        page.wait_for_timeout(2500)
        page.screenshot(path=str(ROOT / PICTURES / f"{name}.jpg"), type="jpeg", quality=85)


def write_estimate(scene: Path, path: Path) -> None:
    """The joints of a tracker that is wrong by SHIFT, from a simulation without the page."""
    with Simulation(Scene.load(scene)) as simulation, path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["stamp", "person", "joint", "x", "y", "z"])
        for frame in simulation.frames(FRAMES):
            for name, human in frame.humans.items():
                for joint, point in zip(human.joint_names, human.positions, strict=True):
                    writer.writerow([frame.stamp, name, joint, *np.add(point, [SHIFT, 0, 0])])


def test_a_mesh_and_a_motion_become_a_data_set_and_an_evaluation(chromium: Any, tmp_path: Path) -> None:
    own = tmp_path / "downloads"
    own.mkdir()
    shutil.copy(mesh_path("own_female_A_dm.obj"), own / "my person.obj")
    shutil.copy(STAND_INS["own_mixamo"].path(), own / "my walk.bvh")
    (own / "cube.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (own / "not a motion.bvh").write_text("hello")
    folder = tmp_path / "scene"
    folder.mkdir()
    with served(str(folder), "--port", "0") as (address, _):
        page = chromium.new_page(viewport={"width": 1400, "height": 900})
        page.set_default_timeout(120_000)
        page.goto(address)
        page.get_by_text("The scene has no people.").wait_for()
        page.get_by_text("The scene has no cameras.").wait_for()

        # 1. a person of the mesh
        tab(page, "Human")
        upload(page, "Upload a mesh of a person, or a human", own / "cube.obj")
        page.get_by_text("the mesh is flat, not a person").first.wait_for()
        upload(page, "Upload a mesh of a person, or a human", own / "my person.obj")
        page.get_by_text("drag the yellow joints").wait_for()
        page.wait_for_timeout(3000)
        picture(page, "from_nothing_skeleton")
        press(page, "Compute weights")
        page.get_by_text("weights of up to").wait_for()
        picture(page, "from_nothing_weights")
        field(page, "Name").fill("anna")
        page.wait_for_timeout(500)
        press(page, "Add to the scene")
        until(lambda: (folder / "anna.npz").is_file())
        page.wait_for_function("window.humansim.people === 1")

        # 2. its motion, and cameras
        tab(page, "Edit")
        choose(page, "Item", "person anna")
        page.get_by_text("motion", exact=True).filter(visible=True).first.click()
        upload(page, "Upload file …", own / "not a motion.bvh")
        page.get_by_text("is not a motion of a person").first.wait_for()
        upload(page, "Upload file …", own / "my walk.bvh")
        until(lambda: (folder / "my_walk.bvh").is_file())
        page.get_by_text("Joints of the motion").click()
        page.get_by_text("matched by names").wait_for()
        for _ in range(2):
            press(page, "camera")
            page.wait_for_timeout(1500)
        press(page, "Save")
        until(lambda: (folder / "scene.yaml").is_file())

        # 3. a data set
        tab(page, "Run")
        field(page, "Frames").fill(str(FRAMES))
        page.keyboard.press("Enter")
        press(page, "export")
        page.wait_for_timeout(500)
        press(page, "Start")
        page.get_by_text("has finished").wait_for()
        assert list((folder / "scene_export").rglob("*.json"))

        # 4. an evaluation of an estimate
        write_estimate(folder / "scene.yaml", own / "estimate.csv")
        upload(page, "Upload an estimate of a tracker", own / "estimate.csv")
        page.wait_for_timeout(500)
        press(page, "Start")
        link = page.get_by_role("link", name="scene_report.html")
        link.wait_for()
        picture(page, "from_nothing_run")
        report = chromium.new_page()
        report.goto(f"{address}{link.get_attribute('href')}")
        assert "20.0" in report.inner_text("body")  # millimetres
        assert report.evaluate("window.origin") == "null"  # its scripts do not reach the page
        report.close()
        page.close()

    scene = Scene.load(folder / "scene.yaml")
    assert list(scene.actors) == ["anna"] and len(scene.cameras) == 2
    person = load_human(folder / "anna.npz")
    assert len(person.mesh.vertices) > 10_000 and np.ptp(person.mesh.vertices[:, 1]) == pytest.approx(
        1.75, abs=0.1
    )
    names = sorted(path.name for path in folder.iterdir())
    assert "not_a_motion.bvh" not in names and not any(name.startswith(".") for name in names)
