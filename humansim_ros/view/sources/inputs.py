"""Opens scenes, bags, motions, humans, calibrations and photographs by content, for ``humansim view``."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from humansim_ros.cameras.camera import Camera, Rig
from humansim_ros.cameras.formats import read_calibration
from humansim_ros.data.bags import is_bag
from humansim_ros.data.evaluation import LiveOptions, set_of_names, split_topic
from humansim_ros.errors import EvaluationError, HumansimError, SceneError, did_you_mean, some_of
from humansim_ros.files.mesh import Mesh
from humansim_ros.files.reading import built_in_names, exists, missing_file, resource_path
from humansim_ros.files.yaml import has_key, read_yaml
from humansim_ros.motion.files import find_motion, is_smpl_motion, motion_format
from humansim_ros.people.humans import Human
from humansim_ros.people.loading import find_human, load_human
from humansim_ros.scene.config import RECIPE, check_config, load_config
from humansim_ros.scene.core import DEMO_SCENE, Scene
from humansim_ros.view.edit.document import SceneDocument
from humansim_ros.view.edit.photo_document import PhotoDocument
from humansim_ros.view.edit.scene_file import EMPTY_SCENE
from humansim_ros.view.sources.photo_source import PhotoSource
from humansim_ros.view.sources.scene_source import SceneViewSource
from humansim_ros.view.sources.source import POSES, FrameRequest, PixelInfo, ViewFrame, ViewSource
from humansim_ros.view.sources.topic_people import Estimate

#: Cameras around a motion or a human: number; distance and height, metres; point that they look at.
_COUNT, _RADIUS, _HEIGHT, _TARGET = 4, 3.5, 1.8, (0.0, 0.0, 0.9)
_NO_TOPIC = "give a file, a folder or BAG:TOPIC; only bags and graphs have topics"
_BODY = "adult_woman"
_MOTION = "walk"
#: Most YAML files of a folder that are checked whether they are scenes.
_MOST_FILES = 50
#: Keys at the top of YAML files that only scenes have.
_SECTIONS = {"humans", "objects", "world", "variety", "randomise", "room", "rate", "rig"}


@dataclass(frozen=True)
class Opened:
    """A source that was opened, and how to open it again after its file has changed.

    Attributes:
        source: The source.
        path: File of the source; None for built-ins.
        reload: Function that opens the source again; None if that is not possible.
        problem: Why the file cannot be shown. If there is a problem, the source is empty.
        document: The scene, for editing; None if the source is no scene file.
    """

    source: ViewSource
    path: Path | None = None
    reload: Callable[[], ViewSource] | None = None
    problem: str | None = None
    document: SceneDocument | None = None


@dataclass(frozen=True)
class TopicOptions:
    """Options for showing topics of a bag or a graph, and for an estimate next to a bag, graph or scene.

    Attributes:
        estimate: A tracker's estimate: a topic of the bag or graph, in which ``*`` stands for the name of a
            person; or what ``humansim evaluate`` takes: ``BAG:TOPIC``, files, folders. Empty without
            estimate.
        reading: How the estimate is read and compared.
        bodies: Names or files of humans whose bodies the people may have, in addition to the built-in humans.
    """

    estimate: Sequence[str] = ()
    reading: LiveOptions = field(default_factory=LiveOptions)
    bodies: Sequence[Path] = ()

    @property
    def topic(self) -> str | None:
        """Topic of the estimate; None if the estimate is in files, or if there is no estimate."""
        one = self.estimate[0] if len(self.estimate) == 1 else ""
        return one if one and not exists(Path(split_topic(one)[0])) else None

    def arguments(self) -> dict[str, Any]:
        """Arguments for the constructors of :class:`BagViewSource` and :class:`RosViewSource`."""
        humans = [load_human(body) for body in self.bodies]
        return {"estimate": self.topic, "options": self.reading, "humans": humans}

    def beside(self, opened: Opened) -> Opened:
        """Add the estimate, if it is in files, to the source that was opened; returns ``opened``.

        Raises:
            HumansimError: The estimate cannot be read.
        """
        if self.estimate and self.topic is None:
            opened.source.estimate = self.estimate_beside(opened.source)
        return opened

    def estimate_beside(self, source: ViewSource) -> Estimate:
        """Read the files of the estimate, with the frame period and start of a source.

        Raises:
            HumansimError: The estimate cannot be read.
        """
        found = Estimate.read(self.estimate, self.reading, source.period, source.start)
        if isinstance(source, SceneViewSource) and self.reading.keypoints is None:
            points = set_of_names(found.poses.names)  # as humansim evaluate does
            found = replace(found, options=replace(found.options, keypoints=points))
        return found


def open_source(what: Path | None, topics: TopicOptions | None = None) -> Opened:
    """Open a path or the name of a built-in. If ``what`` is None, open the demo scene.

    ``topics``: options for the topics of a bag, and for an estimate next to a bag or scene.

    Raises:
        HumansimError: The path cannot be opened; names file, line and key where these are known.
    """
    if what is not None and is_bag(what):
        from humansim_ros.view.sources.bag_source import BagViewSource

        topics = topics or TopicOptions()
        return topics.beside(Opened(BagViewSource(what, **topics.arguments())))
    if topics is not None:
        return topics.beside(_compared(what, topics))
    if what is not None and has_key(what, "views"):
        return Opened(PhotoSource(PhotoDocument.load(what)))
    if what is None:
        demo = resource_path(DEMO_SCENE)
        copy = SceneDocument.copy_of(demo, Path.cwd())
        return Opened(SceneViewSource(copy.scene(), demo.stem), document=copy)
    if exists(what) and what.is_dir():
        return _open_folder(what)
    if has_key(what, RECIPE):
        load_config(what)  # the error of load_config says what to do
    make = _maker(what)
    if not exists(what):
        return Opened(make())
    document = SceneDocument.load(what) if _is_scene(what) else None
    try:
        if document is not None and document.lacks_cameras:  # the scene is being made
            source = SceneViewSource(document.scene_so_far(), what.stem, has_cameras=False)
            return Opened(source, what, make, document=document)
        if document is not None and not document.errors():  # which has loaded the scene
            return Opened(SceneViewSource(document.scene()), what, make, document=document)
        return Opened(make(), what, make, document=document)
    except HumansimError as error:
        if what.is_dir():
            raise
        return Opened(EmptySource(what.stem), what, make, str(error), document)


def _compared(what: Path | None, topics: TopicOptions) -> Opened:
    """Open a scene to show an estimate next to it.

    Raises:
        HumansimError: There is no such scene, or an option is only for bags and graphs.
    """
    if topics.bodies:
        raise HumansimError("the people of bags and graphs have bodies: leave it out", key="--body")
    if not topics.estimate:
        raise HumansimError("give --estimate as well: these options say how it is read")
    if what is not None and not what.is_dir() and not _is_scene(what):
        raise HumansimError("is no scene, bag or graph, whose people an estimate is compared with", path=what)
    if topics.topic is not None:
        raise EvaluationError(missing_file(Path(split_topic(topics.topic)[0]), _NO_TOPIC), key="--estimate")
    return open_source(what)


def new_scene(folder: Path) -> Opened:
    """Open a new, empty scene in a folder. The folder is created when the first file is saved there.

    Raises:
        HumansimError: ``folder`` is a file.
    """
    if exists(folder) and not folder.is_dir():
        raise HumansimError("a new scene needs a folder, and this is a file", path=folder)
    document = SceneDocument(EMPTY_SCENE, folder=folder)
    source = SceneViewSource(document.scene_so_far(), folder.resolve().name or "scene", has_cameras=False)
    return Opened(source, document=document)


def _open_folder(folder: Path) -> Opened:
    """Open the only scene in a folder; else the folder as a calibration; else a new scene in the folder."""
    scenes = [path for path in sorted(folder.glob("*.y*ml"))[:_MOST_FILES] if _is_scene(path)]
    if len(scenes) == 1:
        return open_source(scenes[0])
    if len(scenes) > 1:
        raise HumansimError(
            f"has several scenes: give one of {some_of(path.name for path in scenes)}", path=folder
        )
    if not _is_calibration(folder):
        return new_scene(folder)
    make = _maker(folder)
    return Opened(make(), folder, make)


def open_graph(topics: TopicOptions | None = None, namespace: str = "") -> Opened:
    """Show a running ROS graph.

    Args:
        topics: Options for the topics. If None, the defaults.
        namespace: Show only topics below this namespace.

    Raises:
        HumansimError: ROS is not installed, or a name is no valid topic or namespace.
    """
    from humansim_ros.ros.processes import prepare_transport, require_ros

    require_ros()
    prepare_transport()
    from humansim_ros.view.sources.ros_source import RosViewSource

    topics = topics or TopicOptions()
    if topics.estimate and topics.topic is None:
        raise HumansimError("a graph has estimates on topics: give one topic, such as /tracker/poses")
    return Opened(RosViewSource(namespace=namespace, **topics.arguments()))


def _maker(what: Path) -> Callable[[], ViewSource]:
    """Return a function that makes the source of a path."""
    if not exists(what):
        return _built_in(what)
    if _is_scene(what):
        return lambda: SceneViewSource(Scene.load(what))
    attempts: tuple[tuple[str, Callable[[], ViewSource]], ...] = (
        ("motion", lambda: _around({"body": _BODY, "motion": str(what.resolve())}, what.stem)),
        ("human", lambda: _around({"body": str(what.resolve()), "motion": _MOTION}, what.stem)),
        ("calibration", lambda: _cameras(what)),
    )
    suffix = what.suffix.lower()
    if (known := motion_format(what)) is not None and not known.also:
        return attempts[0][1]
    if suffix == ".npz":
        return attempts[0 if is_smpl_motion(what) else 1][1]
    problems = []
    for kind, attempt in (attempts[2], attempts[1], attempts[0]):
        try:
            attempt().close()
        except HumansimError as error:
            problems.append(f"  as a {kind}: {error.message}")
        else:
            return attempt
    raise HumansimError("can be opened in no way:\n" + "\n".join(problems), path=what)


def _built_in(what: Path) -> Callable[[], ViewSource]:
    """Return a function that makes the source of a built-in motion or human with this name."""
    name = str(what)
    try:
        find_motion(name, Path.cwd(), SceneError)
        return lambda: _around({"body": _BODY, "motion": name}, name)
    except HumansimError:
        pass
    try:
        find_human(name, Path.cwd(), SceneError)
    except HumansimError:
        known = [*built_in_names("motions"), *built_in_names("humans")]
        hint = f"give a scene, bag, motion, human or calibration{did_you_mean(name, known)}"
        raise HumansimError(missing_file(what, hint)) from None
    return lambda: _around({"body": name, "motion": _MOTION}, name)


def _is_scene(path: Path) -> bool:
    """Whether a file is a scene, or a YAML file that may be a scene with a mistake."""
    if path.suffix.lower() not in (".yaml", ".yml"):
        return False
    try:
        value, _ = read_yaml(path, SceneError, "scene")
    except HumansimError:
        return not _is_calibration(path)  # the reader of scenes names the line of the error
    if not isinstance(value, Mapping):
        return False
    if value.keys() & _SECTIONS:
        return True
    try:
        check_config(value)
    except HumansimError:
        return False
    return True


def _is_calibration(path: Path) -> bool:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return bool(read_calibration(path))
        except HumansimError:
            return False


def _around(human: Mapping[str, Any], title: str) -> ViewSource:
    """Source of a scene with one person (section ``human``) between four cameras, without a room."""
    cameras = Rig(_TARGET, _RADIUS, _HEIGHT).ring(_COUNT)
    scene = Scene.build(humans={"person": dict(human)}, cameras=dict(cameras), room=None)
    return SceneViewSource(scene, title)


def _cameras(path: Path) -> ViewSource:
    """Source with the cameras of a calibration in its world frame; those without poses are at the origin."""
    try:
        scene = Scene.from_dict({"room": None, "rig": {"file": str(path.resolve())}})
    except HumansimError:
        cameras = read_calibration(path)
        if not cameras:
            raise
        scene = Scene.build(cameras=dict(cameras), room=None)
    return SceneViewSource(scene, path.stem)


class EmptySource(ViewSource):
    """A source without people and cameras, which is shown while the file of the page has errors.

    Args:
        title: Title of the page.
    """

    title: str = ""
    people: Mapping[str, Human] = {}
    objects: Mapping[str, Mesh] = {}
    static: Mapping[str, Mesh] = {}
    cameras: Mapping[str, Camera] = {}
    period: int = 33_333_333
    frames: int | None = 2
    channels: tuple[str, ...] = ("rgb",)
    messages: Sequence[str] = ()

    def __init__(self, title: str) -> None:
        self.title = title

    def frame(self, index: int, wanted: FrameRequest = POSES) -> ViewFrame:
        return ViewFrame(index=0, stamp=0, scene_time=0)

    def describe(self, camera: str, x: int, y: int) -> PixelInfo:
        """Raise SceneError, since there are no cameras."""
        raise SceneError(f"no camera {camera!r}: the scene could not be read")

    def close(self) -> None:
        """Do nothing, since there is nothing to free."""
