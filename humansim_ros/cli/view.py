"""``humansim view``: show things in 3D in the browser."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from humansim_ros.cli.output import print_text
from humansim_ros.errors import HumansimError

if TYPE_CHECKING:
    from humansim_ros.view.sources import TopicOptions


@dataclass(frozen=True)
class Estimates:
    """Options about estimates of trackers, and the people of topics. Each attribute has the name of its
    option."""

    estimate: list[str] | None = None
    keypoints: str | None = None
    names: Path | None = None
    scale: float = 1.0
    axes: str | None = None
    body: list[str] | None = None

    def topic_options(self) -> TopicOptions | None:
        """How topics are read; None if no option is given."""
        if self == Estimates():
            return None
        from humansim_ros.data.evaluation import DEFAULT_GATE, LiveOptions
        from humansim_ros.view.sources import TopicOptions

        names = "" if self.names is None else str(self.names)
        reading = LiveOptions.of(self.keypoints or "", names, self.scale, self.axes or "", DEFAULT_GATE)
        return TopicOptions(tuple(self.estimate or ()), reading, tuple(map(Path, self.body or ())))


def view(
    what: Path | None = None,
    port: int = 8080,
    new: bool = False,
    no_browser: bool = False,
    ros: bool = False,
    namespace: str = "",
    *,
    estimates: Estimates,
) -> None:
    """Show a scene, bag, ROS graph, motion, human, calibration or photographs in the browser, in 3D."""
    if find_spec("viser") is None:
        raise HumansimError(
            "humansim view needs the extra 'view' (viser is missing): pip install 'humansim_ros[view]'"
        )
    import cv2

    from humansim_ros.view.sources import new_scene, open_graph, open_source

    topics = estimates.topic_options()
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
