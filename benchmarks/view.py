"""The page of ``humansim view``: frames per second with four people and four cameras, memory over time.

    python benchmarks/view.py [--seconds 15] [--people 4] [--cameras 4] [--pages 1] [--browser]

A row for each set of images: frames of the motion and images per second that the server sends, what one
page receives, and CPU time of the server and of the processes that render, as shares of a core. The pages
receive everything and draw nothing: the machine of the user draws. ``--browser`` opens Chromium with WebGL in
software (playwright) instead, on the same cores. The last line tells the memory of the server after a third
of the last row and at its end; with ``--seconds 600`` it shows whether the page leaks.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from humansim_ros import Scene
from humansim_ros.view.app import ViewApp
from humansim_ros.view.scene_source import SceneViewSource

BODIES, MOTIONS = ("adult_woman", "adult_man", "child"), ("walk", "wave", "run")
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [3.0, 3.0, 3.0],
    "fov": 1.0,
    "near": 0.1,
    "far": 100.0,
    "image_height": 800,
    "image_width": 1280,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}


def scene(people: int, cameras: int) -> Scene:
    """People on a circle, and 640x480 cameras around them."""

    def on_circle(number: int, count: int, radius: float) -> list[float]:
        angle = 2 * np.pi * number / count
        return [float(radius * np.cos(angle)), float(radius * np.sin(angle))]

    return Scene.from_dict(
        {
            "humans": {
                f"person_{number}": {
                    "body": BODIES[number % 3],
                    "motion": {"file": MOTIONS[number % 3], "position": on_circle(number, people, 1.2)},
                }
                for number in range(people)
            },
            "cameras": {
                f"camera_{number}": {
                    "position": [*on_circle(number, cameras, 3.0), 2.2],
                    "look_at": [0, 0, 1],
                }
                for number in range(cameras)
            },
        }
    )


def receive(url: str, path: str, received: Any) -> None:
    """Receive what a page receives, and count messages and bytes."""
    with connect(f"ws{url[4:]}{path}", subprotocols=["viser-v1.1.1"], max_size=None) as page:  # type: ignore[list-item]
        if not path:
            page.send(msgspec.msgpack.encode(CAMERA))
        try:
            while True:
                data = page.recv()
                with received.get_lock():
                    received[0] += 1
                    received[1] += len(data)
        except ConnectionClosed:
            return


def cpu_time(pid: int) -> float:
    """Seconds of CPU time of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory(pid: int) -> float:
    """Memory of a process, MB."""
    (line,) = (
        line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("VmRSS")
    )
    return int(line.split()[1]) / 1024


def measure(
    app: ViewApp, channels: tuple[str, ...], seconds: float, counts: list[Any]
) -> tuple[float, float]:
    """Print a row; returns the memory of the server after a third and at the end, MB."""
    app.post(lambda: setattr(app, "shown_channels", channels))
    while channels and (
        app._frame is None or set(channels) != set(next(iter(app._frame.images.values()), ()))
    ):
        time.sleep(0.1)
    time.sleep(2)
    workers = [
        process.pid for process in multiprocessing.active_children() if process.name == "humansim images"
    ]
    images: list[Any] = [None]
    watching = threading.Event()

    def watch() -> None:
        while not watching.wait(0.005):
            frame = app._frame
            if frame is not None and frame.image_index not in (None, images[-1]):
                images.append(frame.image_index)

    threading.Thread(target=watch, daemon=True).start()
    before = (
        app.frames_shown,
        [count[:] for count in counts],
        cpu_time(os.getpid()),
        list(map(cpu_time, workers)),
    )
    start = time.perf_counter()
    time.sleep(seconds / 3)
    early = memory(os.getpid())
    time.sleep(2 * seconds / 3)
    passed = time.perf_counter() - start
    watching.set()
    frames = (app.frames_shown - before[0]) / passed
    received = [
        [(now - then) / passed for now, then in zip(count[:], old, strict=True)]
        for count, old in zip(counts, before[1], strict=True)
    ]
    messages = sum(row[0] for row in received) / max(len(received) / 2, 1)
    megabytes = sum(row[1] for row in received) / max(len(received) / 2, 1) / 1e6
    server = (cpu_time(os.getpid()) - before[2]) / passed
    render = sum(cpu_time(pid) - old for pid, old in zip(workers, before[3], strict=True)) / passed
    name = ", ".join(channels) or "none"
    print(
        f"{name:24} {frames:10.1f} {(len(images) - 1) / passed:10.1f} {messages:12.0f} {megabytes:8.2f} "
        f"{server:10.2f} {render:10.2f}"
    )
    return early, memory(os.getpid())


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--people", type=int, default=4)
    parser.add_argument("--cameras", type=int, default=4)
    parser.add_argument("--pages", type=int, default=1)
    parser.add_argument("--browser", action="store_true")
    options = parser.parse_args()
    app = ViewApp(SceneViewSource(scene(options.people, options.cameras)), 0)
    threading.Thread(target=run_pages, args=(app, options), daemon=True).start()
    app.run()
    app.close()


def run_pages(app: ViewApp, options: argparse.Namespace) -> None:
    """Open the pages, and print a row for each set of images."""
    counts: list[Any] = []
    spawn = multiprocessing.get_context("spawn")
    with ExitStack() as stack:
        try:
            if options.browser:
                from playwright.sync_api import sync_playwright

                chromium = stack.enter_context(sync_playwright()).chromium
                software = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
                opened = chromium.launch(executable_path="/usr/bin/chromium", args=software)
                stack.callback(opened.close)
                for _ in range(options.pages):
                    opened.new_page(viewport={"width": 1280, "height": 800}).goto(app.server.url)
            else:
                for path in ("", "/humansim/frames") * options.pages:
                    count = spawn.Array("q", 2)
                    counts.append(count)
                    process = spawn.Process(target=receive, args=(app.server.url, path, count), daemon=True)
                    process.start()
                    stack.callback(process.kill)
            while len(app.server.viser.get_clients()) < options.pages:
                time.sleep(0.1)
            print(f"{options.people} people, {options.cameras} cameras of 640x480, pages: {options.pages}")
            print(
                f"{'images':24} {'motion/s':>10} {'images/s':>10} {'messages/s':>12} {'MB/s':>8} "
                f"{'server':>10} {'rendering':>10}"
            )
            for channels in ((), ("rgb",), ("rgb", "depth"), ("joints",)):
                early, late = measure(app, channels, options.seconds, counts)
            print(f"memory of the server: {early:.0f} MB, then {late:.0f} MB")
        finally:
            app.stop()


if __name__ == "__main__":
    main()
