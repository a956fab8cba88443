"""The page of a running graph in a headless Chromium: who comes is shown, and what is missing is told."""

from __future__ import annotations

from typing import Any

import pytest
from ros_support import Client
from waiting import wait_until

pytest.importorskip("viser")
pytest.importorskip("playwright")

from pages import browser, needs_browser, served

from humansim_ros import Scene

pytestmark = [needs_browser, pytest.mark.nightly, pytest.mark.slow, pytest.mark.process]


def test_people_who_come_are_shown(ros: None) -> None:
    from sensor_msgs.msg import MultiDOFJointState
    from shape_msgs.msg import Mesh as MeshMessage

    from humansim_ros.data.messages.humans import joints_message, mesh_message
    from humansim_ros.ros.graph.qos import LATCHED

    actor, client = Scene.load().actors["walker"], Client()
    state, mesh = actor.at(0.0), mesh_message(actor.human.mesh)
    stamps = iter(range(10**9, 10**14, 10**8))

    def shown(page: Any, script: str, publisher: Any = None) -> bool:
        def step() -> None:
            if publisher is not None:
                publisher.publish(joints_message(state, next(stamps)))
            page.wait_for_timeout(50)

        return wait_until(lambda: page.evaluate(script), step=step)

    try:
        with served("--ros", "--namespace", "late", "--port", "0") as (url, _), browser() as chromium:
            page = chromium.new_page(viewport={"width": 1280, "height": 800})
            page.goto(url)
            text = "document.body.innerText.includes"
            assert shown(page, f"{text}('can be shown yet: start humansim run')")
            client.node.create_publisher(MeshMessage, "/late/humans/x/mesh", LATCHED).publish(mesh)
            people = client.node.create_publisher(MultiDOFJointState, "/late/humans/x/joints", 5)
            assert shown(page, "window.humansim && window.humansim.textured >= 1", people)
            assert shown(page, f"{text}('The graph has no cameras')", people)
            # the timeline grows while it runs; a click on it does not move the time
            frames = "fetch('/humansim/tracks.json').then((a) => a.json()).then((t) => t.frames)"
            before = page.evaluate(frames)
            assert shown(page, f"{frames}.then((now) => now > {before} + 10)", people)
            assert shown(page, f"{text}('live, the last')", people)
            labels = page.get_by_role("list", name="Tracks").get_by_role("listitem")
            assert [label.inner_text() for label in labels.all()] == ["late/x"]
            assert page.get_by_role("slider", name="Time").get_attribute("aria-readonly") == "true"
    finally:
        client.close()
