"""What products need of a frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest

from humansim_ros.errors import RenderError, SceneError
from humansim_ros.scene import Needs, Scene, Simulation


@dataclass(frozen=True)
class Product:
    needs: Needs


def test_products_need_together_what_each_of_them_needs() -> None:
    one = Needs(["depth", "rgb"], ["left"], ["lidar"], ["left"])
    other = Needs(("amodal", "rgb"), ["right"])
    together = Needs.of([Product(one), Product(other)])
    assert together == Needs(("rgb", "depth", "amodal"), ("left", "right"), ("lidar",), ("left",))
    assert together.ordered_channels == ("rgb", "depth", "amodal")


@pytest.mark.parametrize("field", ["cameras", "scanners"])
def test_a_product_that_needs_all_is_served(field: str) -> None:
    some: dict[str, Any] = {field: ["left"]}
    everything: dict[str, Any] = {field: None}
    together = Needs.of([Product(Needs(**some)), Product(Needs(**everything))])
    assert getattr(together, field) is None


def test_no_products_need_nothing() -> None:
    assert Needs.of([]) == Needs((), (), (), ())


def test_a_single_name_is_one_name() -> None:
    assert Needs("rgb", "left") == Needs(["rgb"], ["left"])


def test_an_unknown_channel_is_refused() -> None:
    with pytest.raises(RenderError, match="no such channel: colour"):
        Needs(("colour",))


@pytest.fixture(scope="module")
def simulation() -> Iterator[Simulation]:
    place = {"size": [32, 24], "position": [3, 0.4, 1.4], "look_at": [0, 0, 1]}
    scene = Scene.from_dict({"room": None, "cameras": {"left": place, "right": place}})
    with Simulation(scene, ("rgb", "depth")) as simulation:
        yield simulation


def test_a_frame_has_what_is_needed(simulation: Simulation) -> None:
    frame = simulation.frame(1, Needs(("instance",), ["right"]))
    assert list(frame.views) == ["right"] and frame.views["right"].channels == ("instance",)


def test_without_needs_a_frame_has_the_channels_of_the_simulation(simulation: Simulation) -> None:
    views = simulation.frame(1).views
    assert list(views) == ["left", "right"] and views["left"].channels == ("rgb", "depth")


@pytest.mark.parametrize("field", ["cameras", "scanners"])
def test_an_unknown_name_is_refused(simulation: Simulation, field: str) -> None:
    with pytest.raises(SceneError, match=r"no (camera|scanner) 'up'"):
        simulation.frame(1, Needs(**{field: ["up"]}))


def test_former_arguments_still_work(simulation: Simulation) -> None:
    with pytest.warns(DeprecationWarning, match=r"deprecated: give Needs; 0\.4\.0 removes them"):
        frame = simulation.frame(1, cameras=["left"], rectified_depth=["left"])
    assert list(frame.views) == list(frame.rectified_depth) == ["left"]
    assert frame.views["left"].channels == ("rgb", "depth")
    former: Any = ()
    with pytest.warns(DeprecationWarning, match="Needs"):
        frame = simulation.frame(1, former)
    assert not frame.views
