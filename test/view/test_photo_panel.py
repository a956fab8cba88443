"""The tab of photographs without a browser: requests of pages, solving in a thread."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser")

from photographs.studio import make_studio
from waiting import wait_until

from humansim_ros.errors import HumansimError
from humansim_ros.photographs.views import read_points
from humansim_ros.view.app import ViewApp
from humansim_ros.view.panels.photographs import PhotographsPanel
from humansim_ros.view.sources import photo_source
from humansim_ros.view.sources.inputs import open_source
from humansim_ros.view.sources.photo_source import PhotoSource


class Opened:
    """A page of photographs without a browser, and what it has told."""

    def __init__(self, path: Path) -> None:
        opened = open_source(path)
        source = opened.source
        assert isinstance(source, PhotoSource)
        self.source, self.document = source, source.document
        self.app = ViewApp(opened, 0)
        panel = self.app._images
        assert isinstance(panel, PhotographsPanel)
        self.panel = panel
        self.told: list[tuple[str, str]] = []
        self.app.notify = lambda title, text: self.told.append((title, text))  # type: ignore[method-assign]

    def show(self) -> bool:
        """Show the frame; False while a solution is being computed."""
        self.panel.update(self.source.frame(self.app.player.index))
        return not self.source.solver.runs


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Opened]:
    made = Opened(make_studio(tmp_path, images=False, noise=1.0).path)
    yield made
    made.app.close()


@pytest.fixture(scope="module")
def unchanged(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Opened]:
    """A page for tests that change nothing."""
    made = Opened(make_studio(tmp_path_factory.mktemp("studio"), images=False).path)
    yield made
    made.app.close()


SET = {"do": "set", "frame": "0", "view": "view_1", "point": "nose", "x": "10", "y": "20"}


def test_a_page_sets_a_point(page: Opened) -> None:
    page.panel.act(SET)
    assert page.document.state.points[0][0, 0].tolist() == [10, 20, 1]
    page.panel.act({"do": "undo"})
    assert not page.document.changed


@pytest.mark.parametrize(
    "wrong",
    [
        {"x": "nan"},
        {"y": "-inf"},
        {"x": "1e999"},
        {"x": "ten"},
        {"x": "9" * 400},
        {"frame": "1"},
        {"frame": "-1"},
        {"frame": "9" * 5000},
        {"frame": "0.5"},
        {"frame": ""},
        {"view": "view_5"},
        {"view": "../../etc/passwd"},
        {"view": ""},
        {"point": "__class__"},
        {"point": "0"},
        {"do": "accept"},
        {"do": "remove", "view": "\0"},
        {"do": "exchange", "frame": "7"},
        {"do": "<script>" * 500},
    ],
)
def test_hostile_requests_change_nothing(unchanged: Opened, wrong: dict[str, str]) -> None:
    state = unchanged.document.state
    with pytest.raises(HumansimError) as told:
        unchanged.panel.act(SET | wrong)
    assert unchanged.document.state is state and len(str(told.value)) < 300


@pytest.mark.nightly
def test_solving_shows_the_person_and_can_be_undone(page: Opened) -> None:
    assert page.show() and not page.source.people
    page.panel.toggle_solving()
    with pytest.raises(HumansimError, match="is being computed"):
        page.source.solver.start(page.document, False)
    assert wait_until(page.show)
    assert page.document.undo_label == "Solve" and list(page.source.people) == ["person"]
    assert page.document.state.same == "humansim human fit views.yaml -o fit.yaml --no-silhouettes"
    page.panel.act({"do": "undo"})
    assert not page.source.people
    page.panel.act({"do": "redo"})
    page.panel.accept()
    assert page.told[-1] == ("Accepted", "wrote fit.yaml")


def test_a_stopped_solution_changes_nothing(page: Opened, monkeypatch: pytest.MonkeyPatch) -> None:
    def endless(*_: Any, progress: Any, **__: Any) -> None:
        while True:
            progress("poses", 1, 2)

    monkeypatch.setattr(photo_source, "fit_person", endless)
    page.panel.toggle_solving()
    assert wait_until(lambda: "1 of 2" in page.source.solver.progress)
    page.panel.toggle_solving()
    assert wait_until(page.show)
    assert not page.document.changed and not page.told


def test_points_that_determine_nobody_are_told(page: Opened) -> None:
    for view in ("view_1", "view_2", "view_3"):
        for name in page.document.keypoints.names:
            if page.document.photo(0, view).points[page.document.keypoints.index(name), 2] > 0:
                page.panel.act({"do": "remove", "frame": "0", "view": view, "point": name})
    page.panel.toggle_solving()
    assert wait_until(page.show)
    assert any(title == "There is no solution" for title, _ in page.told), page.told
    assert page.document.state.fit is None


def test_a_fault_in_a_solution_does_not_end_the_page(page: Opened, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise FloatingPointError("no inverse")

    monkeypatch.setattr(photo_source, "fit_person", broken)
    page.panel.toggle_solving()
    assert wait_until(page.show)
    assert page.told == [("There is no solution", "the solution has failed: FloatingPointError: no inverse")]


def test_the_page_writes_what_read_points_reads(page: Opened) -> None:
    page.panel.act(SET)
    page.panel.accept()
    path = page.document.photos.points_files["view_1"]
    assert read_points(path, page.document.keypoints)[0][0].tolist() == [10, 20, 1]


@pytest.mark.nightly
def test_each_frame_has_its_photographs_and_points(tmp_path: Path) -> None:
    made = make_studio(tmp_path, frames=2)
    (tmp_path / "view_3" / "000001.jpg").write_bytes(b"no picture")
    page = Opened(made.path)
    try:
        server = page.app.server
        page.show()
        assert {name for name in server.files if name.endswith(".jpg")} == {
            f"/humansim/photographs/0/{number}.jpg" for number in range(4)
        }
        page.app.seek(1)
        page.show()
        shown = json.loads(server.files["/humansim/photographs.json"][1])
        assert shown["frame"] == 1
        assert [view["image"] for view in shown["views"]] == [
            "/humansim/photographs/1/0.jpg",
            "/humansim/photographs/1/1.jpg",
            None,
            "/humansim/photographs/1/3.jpg",
        ]
        assert not any(name.startswith("/humansim/photographs/0/") for name in server.files)
        (told,) = page.source.messages
        assert "000001.jpg" in told
        np.testing.assert_allclose(
            shown["views"][0]["points"][0], page.document.photos.points[1, 0, 0, :2], atol=0.006
        )
        page.panel.act(SET | {"frame": "1"})
        page.show()
        assert json.loads(server.files["/humansim/photographs.json"][1])["views"][0]["points"][0] == [10, 20]
    finally:
        page.app.close()
