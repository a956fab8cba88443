"""``humansim view``: show things in 3D in the browser."""

from __future__ import annotations

import threading
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from humansim_ros.cli.options import (
    AxesOption,
    KeypointsOption,
    NamesOption,
    ScaleOption,
    argument,
    built_in_humans,
    list_option,
    option,
)
from humansim_ros.cli.output import print_text
from humansim_ros.errors import HumansimError


def view(
    what: Annotated[Path | None, argument("view.what")] = None,
    port: Annotated[int, option("view.port")] = 8080,
    new: Annotated[bool, option("view.new")] = False,
    no_browser: Annotated[bool, option("view.no_browser")] = False,
    ros: Annotated[bool, option("view.ros")] = False,
    namespace: Annotated[str, option("view.namespace")] = "",
    estimate: Annotated[list[str] | None, list_option("view.estimate")] = None,
    keypoints: KeypointsOption = None,
    names: NamesOption = None,
    scale: ScaleOption = 1.0,
    axes: AxesOption = None,
    body: Annotated[list[str] | None, list_option("view.body", built_in_humans)] = None,
) -> None:
    """Show a scene, bag, ROS graph, motion, human, calibration or photographs in the browser, in 3D."""
    if find_spec("viser") is None:
        raise HumansimError(
            "humansim view needs the extra 'view' (viser is missing): pip install 'humansim_ros[view]'"
        )
    import cv2

    from humansim_ros.data.evaluation import DEFAULT_GATE, LiveOptions
    from humansim_ros.view.sources import TopicOptions, new_scene, open_graph, open_source

    topics = None
    if estimate or keypoints is not None or names is not None or body or scale != 1 or axes is not None:
        table = "" if names is None else str(names)
        reading = LiveOptions.of(keypoints or "", table, scale, axes or "", DEFAULT_GATE)
        topics = TopicOptions(tuple(estimate or ()), reading, tuple(map(Path, body or ())))
    if ros and what is not None:
        raise HumansimError("a graph is shown, or a file: leave out one of --ros and the path", key="--ros")
    if namespace and not ros:
        raise HumansimError("is for graphs: give --ros as well", key="--namespace")
    if new and (ros or topics is not None):
        raise HumansimError(
            "a new scene has no people: leave out --ros and options of estimates", key="--new"
        )
    if new:
        opened = new_scene(what or Path.cwd())
    else:
        cv2.setNumThreads(1)  # its threads would not be copied
        opened = open_graph(topics, namespace) if ros else open_source(what, topics)
        source = opened.source
        # before the imports of the page, so that images are rendered at the same time
        source.prepare(tuple(source.cameras), source.channels[:1], alone=True)
        cv2.setNumThreads(-1)
    from humansim_ros.view import ViewApp

    app = ViewApp(opened, port)
    try:
        if port not in (0, app.server.port):
            print_text(f"port {port} is in use")
        print_text(f"open {app.server.url} to see {opened.source.title}; Ctrl-C ends")
        if opened.problem is not None:
            print_text(f"the page shows what is wrong, and the scene when it is mended:\n{opened.problem}")
        if not no_browser:
            threading.Thread(target=_open_browser, args=(app.server.url,), daemon=True).start()
        app.run()
    except KeyboardInterrupt:
        pass
    finally:
        app.close()


def _open_browser(url: str) -> None:
    import webbrowser

    webbrowser.open(url)
