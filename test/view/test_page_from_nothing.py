"""From an empty folder to a data set and an evaluation, by clicks and uploads in a headless Chromium."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from mesh_files import mesh_path
from stand_ins import STAND_INS

pytest.importorskip("viser")
pytest.importorskip("playwright")

from labs import write_estimate
from pages import choose, field, needs_browser, press, served, tab, until, upload
from waiting import PATIENCE

from humansim_ros import Scene, load_human

pytestmark = [needs_browser, pytest.mark.nightly, pytest.mark.slow, pytest.mark.process]

PICTURES = os.environ.get("HUMANSIM_PICTURES")
FRAMES = 5
#: The error of the estimate, metres.
SHIFT = 0.02


def picture(page: Any, name: str) -> None:
    if PICTURES:
        page.add_style_tag(content=".mantine-Notifications-root { opacity: 0 }")
        page.wait_for_timeout(2500)
        page.screenshot(path=str(ROOT / PICTURES / f"{name}.jpg"), type="jpeg", quality=85)


def test_a_mesh_and_a_motion_become_a_data_set_and_an_evaluation(chromium: Any, tmp_path: Path) -> None:
    own = tmp_path / "downloads"
    own.mkdir()
    shutil.copy(mesh_path("own_female_A_dm.obj"), own / "my person.obj")
    shutil.copy(STAND_INS["own_mixamo"].path(), own / "my walk.bvh")
    (own / "cube.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (own / "not a motion.bvh").write_text("hello")
    (own / "empty.bvh").touch()
    folder = tmp_path / "scene"
    folder.mkdir()
    with served(str(folder), "--port", "0") as (address, _):
        page = chromium.new_page(viewport={"width": 1400, "height": 900})
        page.set_default_timeout(1000 * PATIENCE)
        page.goto(address)
        page.get_by_text("The scene has no people.").wait_for()
        page.get_by_text("The scene has no cameras.").wait_for()

        # 1. a person of the mesh
        tab(page, "Human")
        upload(page, "Upload a mesh or a human", own / "cube.obj")
        page.get_by_text("the mesh is flat, not a person").first.wait_for()
        upload(page, "Upload a mesh or a human", own / "my person.obj")
        page.get_by_text("drag the yellow joints").wait_for()
        page.wait_for_timeout(3000)
        picture(page, "from_nothing")
        press(page, "Compute weights")
        page.get_by_text("weights of up to").wait_for()
        field(page, "Name").fill("anna")
        page.wait_for_function("document.body.innerText.includes('human build anna.yaml')")  # the command
        press(page, "Add to the scene")
        until(lambda: (folder / "anna.npz").is_file())
        page.wait_for_function("window.humansim.people === 1")

        # 2. its motion, and cameras
        tab(page, "Edit")
        choose(page, "Item", "person anna")
        page.get_by_text("motion", exact=True).filter(visible=True).first.click()
        upload(page, "Upload file …", own / "empty.bvh")
        page.get_by_text("this file is empty").first.wait_for()  # the page itself refuses it
        upload(page, "Upload file …", own / "not a motion.bvh")
        page.get_by_text("is not a motion of a person").first.wait_for()
        upload(page, "Upload file …", own / "my walk.bvh")
        until(lambda: (folder / "my_walk.bvh").is_file())
        page.get_by_text("Joints of the motion").click()
        page.get_by_text("matched by names").wait_for()
        for number in (1, 2):
            press(page, "camera")
            until(lambda n=number: field(page, "Item").input_value() == f"camera camera_{n}")
        press(page, "Save")
        until(lambda: (folder / "scene.yaml").is_file())

        # 3. a data set
        tab(page, "Run")
        field(page, "Frames").fill(str(FRAMES))
        page.keyboard.press("Enter")
        press(page, "export")
        until(
            lambda: (
                f"humansim export scene.yaml -o scene_export --format coco --frames {FRAMES}"
                == field(page, "Line").input_value()
            )
        )
        press(page, "Start")
        page.get_by_text("has finished").wait_for()
        assert list((folder / "scene_export").rglob("*.json"))

        # 4. an evaluation of an estimate
        write_estimate(folder / "scene.yaml", own / "estimate.csv", FRAMES, {"anna": SHIFT})
        upload(page, "Upload an estimate of a tracker", own / "estimate.csv")
        until(lambda: "--estimate estimate.csv" in field(page, "Line").input_value())
        # the page shows it beside the truth, too
        page.get_by_label("Curve", exact=True).select_option("estimate error")
        until(lambda: page.locator("#humansim-timeline .values").inner_text() == "anna 20 mm")
        press(page, "Start")
        link = page.get_by_role("link", name="scene_report.html")
        link.wait_for()
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
