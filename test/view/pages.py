"""Pages of humansim view in a headless Chromium, for tests."""

from __future__ import annotations

import contextlib
import os
import re
import selectors
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import ROOT
from waiting import PATIENCE, end_process, wait_until

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
#: WebGL in software, as on a machine without GPU.
_SOFTWARE = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (apt install chromium)")


@contextlib.contextmanager
def served(*arguments: str, cwd: Path | None = None) -> Iterator[tuple[str, list[str]]]:
    """The page of ``humansim view ARGUMENTS``: its address, and all lines printed up to it."""
    environment = os.environ | {"PYTHONUNBUFFERED": "1", "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, "-m", "humansim_ros", "view", *arguments, "--no-browser"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=cwd,
        env=environment,
    )
    lines: list[str] = []
    try:
        assert process.stdout is not None
        with selectors.DefaultSelector() as selector:
            selector.register(process.stdout, selectors.EVENT_READ)
            limit = time.monotonic() + PATIENCE
            while not any("http://" in line for line in lines):
                assert time.monotonic() < limit and process.poll() is None, "".join(lines)
                if selector.select(1.0):
                    lines.append(process.stdout.readline())
        found = re.search(r"http://127\.0\.0\.1:\d+", lines[-1])
        assert found is not None, lines
        yield found.group(), lines
    finally:
        end_process(process)


@contextlib.contextmanager
def running_app(path: Path, estimate: str | None = None) -> Iterator[Any]:
    """The page of a file, with an estimate beside it or not, served by a thread of this process."""
    from humansim_ros.view.app import ViewApp
    from humansim_ros.view.sources import scene_source, tracks
    from humansim_ros.view.sources.inputs import TopicOptions, open_source

    opened = open_source(path, None if estimate is None else TopicOptions([estimate]))
    made = ViewApp(opened, 0)

    def serve() -> None:
        made.run()
        made.close()  # in this thread, whose renderers it has

    thread = threading.Thread(target=serve)
    with pytest.MonkeyPatch.context() as patch:
        # Chromium draws without a GPU: on a busy machine, nice workers would get no time beside it
        for module in (scene_source, tracks):
            patch.setattr(module, "_NICE", 0)
        thread.start()
        try:
            yield made
        finally:
            made.stop()
            thread.join()


def told_app(opened: Any) -> tuple[Any, list[str]]:
    """A page without a browser, and the texts of its notifications."""
    from humansim_ros.view.app import ViewApp

    app, told = ViewApp(opened, 0), list[str]()
    app.notify = lambda title, text: told.append(text)  # type: ignore[method-assign]
    return app, told


@contextlib.contextmanager
def paused_page(path: Path, estimate: str | None = None, people: int = 1) -> Iterator[tuple[Any, Any]]:
    """A tab of the page of a file, paused, and the page."""
    with running_app(path, estimate) as app, browser() as chromium:
        page = opened_page(chromium, app.server.url, people)
        pause(page)
        yield page, app


@contextlib.contextmanager
def browser() -> Iterator[Any]:
    """A headless Chromium."""
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=list(_SOFTWARE))
        try:
            yield opened
        finally:
            opened.close()


def opened_page(chromium: Any, url: str, people: int = 1, size: tuple[int, int] = (1280, 800)) -> Any:
    """A tab that shows its people with their textures."""
    page = chromium.new_page(viewport={"width": size[0], "height": size[1]})
    page.set_default_timeout(1000 * PATIENCE)
    page.goto(url)
    page.wait_for_function(
        f"window.humansim && window.humansim.textured >= {people} && window.humansim.frame !== null"
    )
    return page


def pause(page: Any) -> None:
    """Pause, if it plays. The buttons come later than the images."""
    page.get_by_role("button", name=re.compile("^(Play|Pause)$")).first.wait_for()
    button = page.get_by_role("button", name="Pause", exact=True)
    if button.count():
        button.click()
        page.get_by_role("button", name="Play", exact=True).wait_for()


def scrub(page: Any, frame: int) -> None:
    """Type a frame into the number beside the slider, and wait until the page shows it."""
    field = page.locator("input[inputmode]").first
    field.fill(str(frame))
    field.press("Enter")
    page.wait_for_function(f"window.humansim.frame === {frame}")


def tiles_of(page: Any) -> dict[str, Any]:
    """RGB images (H, W, 3) of the tiles on the page by "camera channel"; none before they have arrived."""
    data = page.evaluate(
        """async () => Object.fromEntries(await Promise.all(
            [...document.querySelectorAll("[data-humansim=tiles] figure")].map(async (figure) => {
                const file = await fetch(figure.querySelector("img").src).catch(() => null);
                return [figure.dataset.humansim, file ? [...new Uint8Array(await file.arrayBuffer())] : []];
            })))"""
    )
    if not all(data.values()):  # replaced meanwhile
        return {}
    return {
        name: cv2.imdecode(np.array(file, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        for name, file in data.items()
    }


def three_vertices(page: Any, key: str, numbers: list[int]) -> Any:
    """World positions (N, 3) in ``map`` of vertices, as three.js skins them."""
    return np.array(
        page.evaluate(
            """async ([key, numbers]) => {
                await new Promise(requestAnimationFrame);  // the page poses the bones before each image
                const mesh = window.humansim.meshes.get(key)[0];
                mesh.skeleton.bones.forEach((bone) => bone.updateWorldMatrix(true, false));
                mesh.skeleton.update();
                mesh.updateWorldMatrix(true, false);
                return numbers.map((number) => {
                    const point = mesh.position.clone();
                    mesh.getVertexPosition(number, point);
                    return [point.x, point.y, point.z];
                });
            }""",
            [key, numbers],
        )
    )


def place_of(page: Any, pixel: tuple[float, float], size: tuple[int, int]) -> tuple[float, float]:
    """Point of the page at which a pixel is drawn: the image is as large as the canvas lets it be."""
    box = page.locator("canvas").first.bounding_box()
    scale = min(box["width"] / size[0], box["height"] / size[1])
    return tuple(
        box[start] + box[length] / 2 + scale * (pixel[axis] + 0.5 - size[axis] / 2)
        for axis, (start, length) in enumerate((("x", "width"), ("y", "height")))
    )


def until(condition: Any) -> None:
    """Wait for a condition, and assert it."""
    assert wait_until(condition)


def tracks_of(page: Any) -> Any:
    """What the script of the page gets of the tracks, as far as they have been read."""
    return page.evaluate("fetch('/humansim/tracks.json').then((answer) => answer.json())")


def wait_for_tracks(page: Any) -> None:
    """Wait until the timeline has its rows: they take room from the scene and the images."""
    read = wait_until(lambda: 0 < (table := tracks_of(page)).get("planned", 0) == len(table["sampled"]))
    assert read, str(tracks_of(page))[:500]
    page.get_by_role("list", name="Tracks").get_by_role("listitem").first.wait_for()


# --- controls of the panels


def tab(page: Any, name: str) -> None:
    """Open a tab."""
    page.get_by_role("tab", name=name, exact=True).click()


def upload(page: Any, button: str, file: Path) -> None:
    """Choose a file of this machine in the dialog of a button."""
    with page.expect_file_chooser() as dialog:
        page.get_by_role("button", name=button, exact=True).filter(visible=True).first.click()
    dialog.value.set_files(str(file))


def press(page: Any, button: str) -> None:
    """Press the first visible button of a name."""
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
