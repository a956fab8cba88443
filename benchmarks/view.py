"""The page of ``humansim view``: frames per second with four people and four cameras, memory over time.

    python benchmarks/view.py [--seconds 15] [--people 4] [--cameras 4] [--pages 1] [--browser]
    python benchmarks/view.py --start [--scene FILE] [--repeats 3]
    python benchmarks/view.py --topics [--rate 15] [--cameras 4] [--seconds 15]

A row for each set of images: frames of the motion and images per second that the server sends, what one
page receives, and CPU time of the server and of the processes that render, as shares of a core. The pages
receive everything and draw nothing: the machine of the user draws. ``--browser`` opens Chromium with WebGL in
software (playwright) instead, on the same cores. The last line tells the memory of the server after a third
of the last row and at its end; with ``--seconds 600`` it shows whether the page leaks.

``--start`` starts ``humansim view`` and opens its page in a Chromium that runs already: seconds from the
start of the command until its address is printed, until each camera has an image on the screen, and until
the people in 3D have their textures; and CPU seconds until then of the page, of the processes that render,
and of all together with the browser. Without ``--scene`` it shows people and cameras as above, in the room.

``--topics`` publishes images of 640x480 that have the time in their pixels, shows them with ``humansim view
--ros`` in Chromium, and reads the time from the images on the screen: the age of what is shown, looked at
every 50 ms, and the different images per second of a camera.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import re
import subprocess
import sys
import tempfile
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
from humansim_ros.view.sources.inputs import Opened
from humansim_ros.view.sources.scene_source import SceneViewSource

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


def scene(people: int, cameras: int) -> dict[str, Any]:
    """Scene with people on a circle, and 640x480 cameras around them."""

    def on_circle(number: int, count: int, radius: float) -> list[float]:
        angle = 2 * np.pi * number / count
        return [float(radius * np.cos(angle)), float(radius * np.sin(angle))]

    return {
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


def receive(url: str, path: str, received: Any) -> None:
    """Receive what a page receives, and count messages and bytes."""
    with connect(f"ws{url[4:]}{path}", subprotocols=["viser-v1.1.1"], max_size=None) as page:  # type: ignore[list-item]
        if not path:
            page.send(msgspec.msgpack.encode(CAMERA))
        try:
            while True:
                data = page.recv()
                if isinstance(data, bytes) and data[:4] == b"\xff" * 4 and path:
                    page.send("shown")
                with received.get_lock():
                    received[0] += 1
                    received[1] += len(data)
        except ConnectionClosed:
            return


def browser(stack: ExitStack) -> Any:
    """A Chromium with WebGL in software."""
    from playwright.sync_api import sync_playwright

    chromium = stack.enter_context(sync_playwright()).chromium
    software = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    opened = chromium.launch(executable_path="/usr/bin/chromium", args=software)
    stack.callback(opened.close)
    return opened


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


# --- the start

#: Notes when images are on the screen and people have their textures, in seconds of the system's clock.
WATCH = """
window.noted = {};
setInterval(() => {
    const note = (name, is) => { if (is && !(name in noted)) noted[name] = Date.now() / 1000; };
    const images = [...document.querySelectorAll("[data-humansim=tiles] figure img")];
    note("images", images.filter((image) => image.complete && image.naturalWidth).length >= CAMERAS);
    note("textures", window.humansim && window.humansim.textured >= PEOPLE);
}, 20);
"""


def cpu_times(pid: int) -> dict[int, float]:
    """CPU seconds of a process, of its children that have ended, and of its children that run."""
    found: dict[int, tuple[int, float]] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        found[int(folder.name)] = int(fields[1]), sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")
    tree = added = {pid}
    while added:
        added = {one for one, (parent, _) in found.items() if parent in tree} - tree
        tree = tree | added
    return {one: found[one][1] for one in tree if one in found}


def measure_start(options: argparse.Namespace) -> None:
    """Print a row for each start."""
    with ExitStack() as stack:
        path = options.scene
        if path is None:
            path = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "scene.yaml"
            path.write_text(json.dumps(scene(options.people, options.cameras)))  # YAML, too
        shown = Scene.load(path)
        watch = WATCH.replace("CAMERAS", str(len(shown.cameras))).replace("PEOPLE", str(len(shown.actors)))
        opened = browser(stack)
        print(f"{len(shown.actors)} people, {len(shown.cameras)} cameras; seconds, then CPU seconds")
        names = ("address", "images", "textures", "page", "rendering", "all")
        print("".join(f"{name:>10}" for name in names) + f"{'load':>10}")
        for _ in range(options.repeats):
            row = started(opened, path, watch)
            print("".join(f"{row[name]:10.1f}" for name in names) + f"{os.getloadavg()[0]:10.1f}")


def started(opened: Any, path: Path, watch: str) -> dict[str, float]:
    """Start the command once: seconds and CPU seconds by name."""
    tab = opened.new_page(viewport={"width": 1280, "height": 800})
    tab.add_init_script(watch)
    before, start = sum(cpu_times(os.getpid()).values()), time.time()
    process, address = serve(str(path))
    try:
        row = {"address": time.time() - start}
        tab.goto(address, wait_until="commit")
        tab.wait_for_function("noted.images", timeout=120_000, polling=50)
        own = cpu_times(process.pid)
        row |= {"page": own[process.pid], "rendering": sum(own.values()) - own[process.pid]}
        row["all"] = sum(cpu_times(os.getpid()).values()) - before
        tab.wait_for_function("noted.textures", timeout=120_000, polling=50)
        return row | {name: when - start for name, when in tab.evaluate("noted").items()}
    finally:
        process.terminate()
        process.wait()
        tab.close()


# --- topics

#: Bits of the time in an image, milliseconds, and pixels of the side of the square of each bit.
BITS, SIDE = 24, 24
READ_TIMES = """
window.seen = {};
setInterval(() => {
    const canvas = new OffscreenCanvas(BITS * SIDE, 1).getContext("2d", { willReadFrequently: true });
    for (const figure of document.querySelectorAll("[data-humansim=tiles] figure")) {
        const image = figure.querySelector("img");
        if (!image.complete || !image.naturalWidth) continue;
        canvas.drawImage(image, 0, -SIDE / 2);
        const { data } = canvas.getImageData(0, 0, BITS * SIDE, 1);
        let time = 0;
        for (let bit = 0; bit < BITS; bit += 1)
            time += data[4 * (bit * SIDE + SIDE / 2)] > 127 ? 2 ** bit : 0;
        const age = (Date.now() - time + 2 ** BITS) % 2 ** BITS;
        (seen[figure.dataset.humansim] ||= []).push([age, time]);
    }
}, 50);
""".replace("BITS", str(BITS)).replace("SIDE", str(SIDE))


def publish_times(cameras: int, rate: float, counts: Any) -> None:
    """Publish images with the time in their pixels, until the process is killed. ``counts``: images."""
    from humansim_ros.ros.processes.runtime import prepare_transport

    prepare_transport()
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CameraInfo, Image

    rclpy.init()
    node = rclpy.create_node("times")
    names = [f"/times/camera_{number}" for number in range(cameras)]
    images = [node.create_publisher(Image, f"{name}/image_raw", qos_profile_sensor_data) for name in names]
    infos = [
        node.create_publisher(CameraInfo, f"{name}/camera_info", qos_profile_sensor_data) for name in names
    ]
    pixels = np.random.default_rng(0).integers(80, 160, (480, 640, 3), np.uint8)
    pixels = np.ascontiguousarray(pixels[:60, :80].repeat(8, axis=0).repeat(8, axis=1))
    due = time.monotonic()
    while True:
        now = time.time_ns()
        stamp = {"sec": now // 10**9, "nanosec": now % 10**9}
        bits = (now // 10**6 % 2**BITS) >> np.arange(BITS) & 1
        pixels[:SIDE, : BITS * SIDE] = np.repeat(255 * bits, SIDE).astype(np.uint8)[None, :, None]
        for image, info in zip(images, infos, strict=True):
            message = Image(height=480, width=640, encoding="rgb8", step=1920)
            message.data = pixels.tobytes()
            calibration = CameraInfo(height=480, width=640, k=[500.0, 0, 320, 0, 500, 240, 0, 0, 1])
            for each in (message, calibration):
                each.header.stamp.sec, each.header.stamp.nanosec = stamp["sec"], stamp["nanosec"]
                each.header.frame_id = "camera"
            info.publish(calibration)
            image.publish(message)
        with counts.get_lock():
            counts[0] += 1
        due = max(due + 1 / rate, time.monotonic())
        time.sleep(max(0.0, due - time.monotonic()))


def measure_topics(options: argparse.Namespace) -> None:
    """Print the ages of the images on the screen."""
    spawn = multiprocessing.get_context("spawn")
    with ExitStack() as stack:
        opened = browser(stack)
        counts = spawn.Array("q", 1)
        publisher = spawn.Process(
            target=publish_times, args=(options.cameras, options.rate, counts), daemon=True
        )
        publisher.start()
        stack.callback(publisher.kill)
        tab = opened.new_page(viewport={"width": 1280, "height": 800})
        tab.add_init_script(READ_TIMES)
        process, address = serve("--ros", "--namespace", "times")
        stack.callback(process.wait)
        stack.callback(process.terminate)
        tab.goto(address, wait_until="commit")
        tab.wait_for_function(f"Object.keys(seen).length >= {options.cameras}", timeout=120_000, polling=50)
        time.sleep(5)
        before = counts[0]
        tab.evaluate("seen = {}")
        time.sleep(options.seconds)
        published, seen = (counts[0] - before) / options.seconds, tab.evaluate("seen")
        ages = np.concatenate([[age for age, _ in rows] for rows in seen.values()]) / 1000
        shown = np.mean([len({stamp for _, stamp in rows}) for rows in seen.values()]) / options.seconds
        median, most = np.percentile(ages, [50, 95])
        print(
            f"{options.cameras} cameras, {published:.1f} images/s published, {shown:.1f} on the screen "
            "(looks: 20/s)"
        )
        print(f"age: median {median:.2f} s, 95 % within {most:.2f} s, oldest {ages.max():.2f} s")
        print(f"load {os.getloadavg()[0]:.1f}")


def serve(*arguments: str) -> tuple[subprocess.Popen[str], str]:
    """Start ``humansim view``; its process and address."""
    command = [sys.executable, "-m", "humansim_ros", "view", *arguments, "--no-browser", "--port", "0"]
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    assert process.stdout is not None
    for line in process.stdout:
        if found := re.search(r"http://[0-9.:]+", line):
            return process, found.group()
    raise SystemExit(process.wait())


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
    parser.add_argument("--start", action="store_true")
    parser.add_argument("--topics", action="store_true")
    parser.add_argument("--rate", type=float, default=15.0)
    parser.add_argument("--scene", type=Path)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    if options.start:
        measure_start(options)
        return
    if options.topics:
        measure_topics(options)
        return
    app = ViewApp(Opened(SceneViewSource(Scene.from_dict(scene(options.people, options.cameras)))), 0)
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
                opened = browser(stack)
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
