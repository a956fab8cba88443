"""Recording on a Ray cluster: tasks write shards, the driver writes the index or merges the shards.

A worker writes its shard to a temporary folder, and moves it to the output when it is whole.
``metadata.yaml`` appears last: without it, a folder is no bag.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar
from urllib.parse import urlsplit

from humansim_ros import __version__
from humansim_ros.bags.chunks import Chunk, Compression
from humansim_ros.bags.metadata import NAME as METADATA
from humansim_ros.bags.metadata import Content, metadata_text
from humansim_ros.bags.topics import BagTopic
from humansim_ros.bags.writer import BagWriter
from humansim_ros.errors import BagError, HumansimError, RenderError, some_of
from humansim_ros.io.files import temporary_folder
from humansim_ros.record.output import OutputFolder
from humansim_ros.record.progress import FrameProgress
from humansim_ros.record.shards import SHARD_FRAMES, Shard, ShardKind, merged_chunks, shards_of

if TYPE_CHECKING:
    from humansim_ros.record.frame_chunks import SceneRecording

#: Further attempts after the death of a worker, or after an error that another machine may not have.
_RETRIES = 3
_RETRIED = [OSError, BagError, RenderError, MemoryError]
#: Tasks for each core: one waits while one runs.
_TASKS_PER_CORE = 2
#: Seconds until a host that does not answer is given up.
_CONNECT_LIMIT = 5.0
#: Bytes of the object store of a Ray that is started here, which holds the scenes.
_OBJECT_STORE = 2**29
#: Environment variables of a task, which has one core.
_ONE_CORE = {"LP_NUM_THREADS": "0", "OPENCV_FOR_THREADS_NUM": "1"}
#: File in a folder of shards that is not complete: what is being recorded.
_PLAN = "recording.json"
#: Most shards that an error lists.
_MAX_LISTED = 5


#: Part of a work on a cluster, and what a worker returns for it.
_Work = TypeVar("_Work")
_Result = TypeVar("_Result")


class Encoder(Protocol):
    """Encodes the frames of a recording, in any order."""

    def encode(self, index: int) -> Sequence[Chunk]:
        """Chunks of a frame, in the order of the bag."""


class Recipe(Protocol):
    """Everything that determines a bag. It is sent to workers by pickle."""

    @property
    def topics(self) -> Sequence[BagTopic]:
        """Topics of the bag, with definitions."""

    @property
    def custom(self) -> Mapping[str, str]:
        """``custom_data`` of the bag; it differs if the content of the bag would differ."""

    def encoder(self, cameras: Collection[str], bodies: bool) -> Encoder:
        """Encoder of some cameras, and of the topics that belong to no camera if ``bodies``."""


@dataclass(frozen=True)
class ClusterRecording:
    """A bag to record.

    Attributes:
        recipe: Content.
        shards: Its parts.
        output: Folder of the bag, which gives the bag its name.
        interleaved: They are shards of cameras: each becomes a bag of its own, unless they are merged.
        merge: Make one bag as of one process.
        limits: Limits of the files of a merged bag: ``max_size`` and ``max_duration`` of BagWriter.
        compression: Compression of the chunks.
    """

    recipe: Recipe
    shards: Sequence[Shard]
    output: OutputFolder
    interleaved: bool = False
    merge: bool = False
    limits: Mapping[str, Any] = field(default_factory=dict)
    compression: Compression = "none"

    @property
    def folder(self) -> OutputFolder:
        """Folder of the shards while they are recorded."""
        return OutputFolder(f"{self.output.url.rstrip('/')}.shards") if self.merge else self.output

    def place(self, shard: Shard) -> tuple[OutputFolder, str]:
        """Folder and name of the file of a shard."""
        if self.interleaved and not self.merge:
            camera = shard.cameras[0]
            return self.folder.folder(camera), f"{camera}_0.mcap"
        return self.folder, f"{self.output.name}_{shard.number}.mcap"

    @property
    def plan(self) -> str:
        """Text that says which files the folder of shards will have, with which content."""
        places = [(str(folder.name), name) for folder, name in map(self.place, self.shards)]
        return json.dumps({"version": __version__, "custom": dict(self.recipe.custom), "shards": places})


def cluster_recordings(
    scenes: Mapping[str, SceneRecording],
    output: str,
    kind: ShardKind,
    *,
    shard_frames: int = SHARD_FRAMES,
    merge: bool = False,
) -> list[ClusterRecording]:
    """Bags of scenes.

    Args:
        scenes: Recordings by the name of their folder in ``output``; an empty name is ``output`` itself.
        output: Absolute path or URL.
        kind: Division of each recording.
        shard_frames: Frames of a shard of frames.
        merge: Make bags as of one process.

    Raises:
        BagError: The options of a plan are not for clusters.
    """
    recordings = []
    for name, scene in scenes.items():
        plan, folder = scene.plan, OutputFolder(output)
        if plan.storage != "mcap":
            raise BagError("shards are MCAP files", key="--storage")
        if not merge and (plan.max_size or plan.max_duration):
            message = "each shard is a file: limits of files need --merge, or choose --shard-frames"
            raise BagError(message, key="--max-bag-size" if plan.max_size else "--max-bag-duration")
        recording = ClusterRecording(
            recipe=scene,
            shards=shards_of(kind, scene.frames, scene.cameras, shard_frames),
            output=folder.folder(name) if name else folder,
            interleaved=kind == "cameras" and len(scene.cameras) > 0,
            merge=merge,
            limits={"max_size": plan.max_size, "max_duration": plan.max_duration},
            compression=plan.compression,
        )
        recordings.append(recording)
    return recordings


@dataclass(frozen=True)
class _Job:
    """A shard to write: ``name`` of its file in ``folder``, and the version of the package."""

    shard: Shard
    folder: OutputFolder
    name: str
    version: str = __version__

    def __str__(self) -> str:
        cameras = ", ".join(self.shard.cameras)
        return f"{self.name} (frames {self.shard.first} to {self.shard.end - 1} of {cameras})"


@dataclass(frozen=True)
class ShardResult:
    """A shard that a worker has written: content and bytes."""

    content: Content
    size: int


@dataclass(frozen=True)
class _Content:
    """Content of frames: equal if encoders of it are."""

    custom: tuple[tuple[str, str], ...]
    cameras: tuple[str, ...]
    bodies: bool
    recipe: Recipe = field(compare=False)


@lru_cache(maxsize=1)
def _encoder(content: _Content) -> Encoder:
    """Encoder that stays for the next shard: a renderer takes seconds to draw what does not move."""
    return content.recipe.encoder(content.cameras, content.bodies)


def prepare_worker(version: str) -> None:
    """Prepare the process of a task. Raises HumansimError if the driver has another version."""
    if version != __version__:
        message = f"has humansim_ros {__version__}, and the driver {version}: install the same everywhere"
        raise HumansimError(f"{socket.gethostname()} {message}")
    for name, value in _ONE_CORE.items():
        os.environ.setdefault(name, value)


def write_shard(recipe: Recipe, job: _Job) -> ShardResult:
    """Write a shard of a recipe and move it to the output; this runs in a worker.

    Raises:
        HumansimError: The worker has another version of the package, a disk is full, or the scene cannot be
            loaded or rendered there.
    """
    host, shard = socket.gethostname(), job.shard
    prepare_worker(job.version)
    from humansim_ros.bags.mcap_file import McapFile

    with temporary_folder() as folder:
        path = folder / job.name
        try:
            file = McapFile.create(path, recipe.topics)
            try:
                encoder = _encoder(
                    _Content(tuple(recipe.custom.items()), shard.cameras, shard.bodies, recipe)
                )
                for index in range(shard.first, shard.end):
                    group = encoder.encode(index)
                    for position, chunk in enumerate(group, 1):
                        file.append(chunk, index, position == len(group))
                file.finish()
            finally:
                file.close()
        except OSError as reason:
            text = f"{reason.strerror or reason} on host {host}; TMPDIR of its Ray can name a larger disk"
            raise BagError(text, path=folder.parent) from None
        except BaseException:
            _encoder.cache_clear()  # it may be broken: the next attempt starts from the beginning
            raise
        job.folder.put(path, job.name)
        return ShardResult(file.content, file.size)


def record_on_cluster(
    recordings: Sequence[ClusterRecording],
    address: str,
    *,
    workers: int | None = None,
    resume: bool = False,
    on_progress: Callable[[FrameProgress], None] = lambda _: None,
) -> FrameProgress:
    """Record bags on a Ray cluster. The bags do not depend on the number of workers.

    Args:
        recordings: Bags to record.
        address: ``local`` starts Ray on this machine; ``auto``, ``host:port`` and ``ray://host:port`` name a
            cluster.
        workers: Number of workers of ``local``; one for each core if None.
        resume: Record only what is missing in the outputs.
        on_progress: Called after each shard, with numbers of camera-frames; its argument is also the result.

    Raises:
        BagError: Ray is missing or cannot be reached; an output exists, or holds another recording; or
            shards could not be written, which the message lists. Those that are whole stay for ``resume``.
    """
    written = {recording.output: _written(recording, resume) for recording in recordings}
    with connected(address, workers) as ray:
        tasks = []
        for recording in recordings:
            recipe = ray.put(recording.recipe)  # once for all its tasks
            places = map(recording.place, recording.shards)
            for shard, place in zip(recording.shards, places, strict=True):
                if place not in written[recording.output]:
                    tasks.append((recipe, _Job(shard, *place)))
            _begin(recording)
        total = sum(shard.size for recording in recordings for shard in recording.shards)
        first = total - sum(job.shard.size for _, job in tasks)
        progress = FrameProgress(first, total, first)
        results: dict[_Place, ShardResult] = {}
        start = time.monotonic()

        def add(job: _Job, result: ShardResult) -> None:
            results[job.folder, job.name] = result
            progress.done += job.shard.size
            progress.size += result.size
            progress.seconds = time.monotonic() - start
            on_progress(progress)

        failures = run_tasks(ray, write_shard, tasks, add)
    missing = [job for _, job in tasks if (job.folder, job.name) not in results]
    unwritten = {(job.folder, job.name) for job in missing}
    for recording in recordings:
        if unwritten.isdisjoint(map(recording.place, recording.shards)):
            _finish(recording, results)
    if missing:
        text = missing_text([job.name for job in missing], failures, "shards", "records")
        raise BagError(text, path=missing[0].folder.url)
    return progress


#: Folder and name of the file of a shard.
_Place = tuple[OutputFolder, str]


def _written(recording: ClusterRecording, resume: bool) -> set[_Place]:
    """Places of the shards that an output has. Raises BagError if it is not to be used."""
    output, folder = recording.output, recording.folder
    found = folder.names()
    in_progress = _PLAN in found
    if not resume:
        if in_progress:
            raise BagError("a recording has begun here; --resume completes it", path=folder.url)
        if found or output.names() or (output.local is not None and output.local.exists()):
            raise BagError("this path exists; choose another name for the bag", path=output.url)
        return set()
    places = [recording.place(shard) for shard in recording.shards]
    if not in_progress:
        if output.names():
            return set(places)
        raise BagError("there is no recording to resume here", path=folder.url)
    if folder.read(_PLAN).decode() != recording.plan:
        message = (
            "another recording has begun here: scene, options or version differ; --resume needs the same"
        )
        raise BagError(message, path=folder.url)
    names = {each: each.names() for each in {place[0] for place in places}}
    return {place for place in places if place[1] in names[place[0]]}


def _begin(recording: ClusterRecording) -> None:
    """Make the folders of the shards, with the plan in the first."""
    if METADATA in recording.output.names():
        return
    for folder in dict.fromkeys([recording.folder, *(recording.place(s)[0] for s in recording.shards)]):
        folder.create()
    recording.folder.write(_PLAN, recording.plan.encode())


def run_tasks(
    ray: Any,
    function: Callable[[Any, _Work], _Result],
    tasks: Sequence[tuple[Any, _Work]],
    on_done: Callable[[_Work, _Result], None],
) -> list[str]:
    """Run a function on a cluster, once for each task. After a failure no task is begun.

    Args:
        ray: The module, connected.
        function: Is called in a worker with a reference's value and the work.
        tasks: References, and works; the text of a work names it in errors.
        on_done: Is called with each work and its result.

    Returns:
        Reasons of failures.
    """
    options = {"max_retries": _RETRIES, "retry_exceptions": _RETRIED, "scheduling_strategy": "SPREAD"}
    task = ray.remote(num_cpus=1, **options)(function)
    waiting, running = deque(tasks), dict[Any, _Work]()
    failures: list[str] = []
    try:
        while running or (waiting and not failures):
            limit = _TASKS_PER_CORE * max(1, int(ray.cluster_resources().get("CPU", 1)))
            while waiting and not failures and len(running) < limit:
                reference, work = waiting.popleft()
                running[task.remote(reference, work)] = work
            ray.wait(list(running), num_returns=1)
            for done in ray.wait(list(running), num_returns=len(running), timeout=0)[0]:
                work = running.pop(done)
                try:
                    result = ray.get(done)
                except ray.exceptions.RayError as error:
                    failures.append(f"{work}: {_reason(error)}")
                else:
                    on_done(work, result)
    finally:
        for reference in running:  # after Ctrl-C
            ray.cancel(reference, force=True)
    return failures


def _reason(error: Any) -> str:
    """Reason of a failed task, for people."""
    if type(error).__name__ == "WorkerCrashedError":
        return "its worker was killed, or crashed"
    cause = getattr(error, "cause", None) or error
    text = next(iter(str(cause).strip().splitlines()), "")
    return text if isinstance(cause, HumansimError) else f"{type(cause).__name__}: {text}"


def missing_text(missing: Sequence[str], failures: Sequence[str], what: str, does: str) -> str:
    """Text of an error about parts that could not be written.

    Args:
        missing: Names of the parts.
        failures: Reasons.
        what: Kind of the parts, such as ``shards``.
        does: What ``--resume`` does with them, such as ``records``.
    """
    reasons = "; ".join(failures[:_MAX_LISTED])
    return (
        f"{len(missing)} {what} are missing ({some_of(missing, _MAX_LISTED)}), after {1 + _RETRIES} "
        f"attempts: {reasons}. --resume {does} them, and keeps the others"
    )


def _finish(recording: ClusterRecording, results: Mapping[_Place, ShardResult]) -> None:
    """Make bags of the shards of a recording, which are all there."""
    folder = recording.folder
    if _PLAN not in folder.names():
        return  # it was complete
    places = [recording.place(shard) for shard in recording.shards]
    if recording.merge:
        _merge(recording)
        return
    contents = {place: results[place].content if place in results else _content(*place) for place in places}
    for bag in dict.fromkeys(place[0] for place in places):
        files = [(name, contents[each, name]) for each, name in places if each == bag]
        recipe = recording.recipe
        bag.write(METADATA, metadata_text("mcap", recipe.topics, files, recipe.custom).encode())
    folder.remove(_PLAN)


def _content(folder: OutputFolder, name: str) -> Content:
    """Content of a shard that an earlier run has written."""
    from humansim_ros.bags.mcap_file import content_in

    with folder.open(name) as file:
        return content_in(file, Path(name))


def _merge(recording: ClusterRecording) -> None:
    """Write the bag that one process would have written, and remove the shards."""
    with temporary_folder() as temporary:
        source = recording.folder.local
        work = source if source is not None else temporary
        paths = []
        for folder, name in map(recording.place, recording.shards):
            if source is None:
                folder.get(name, work / name)
            paths.append(work / name)
        bag = work / "merged" / recording.output.name
        shutil.rmtree(bag.parent, ignore_errors=True)  # of a run that was interrupted
        recipe = recording.recipe
        with BagWriter(
            bag,
            recipe.topics,
            compression=recording.compression,
            custom=recipe.custom,
            **recording.limits,
        ) as writer:
            for chunk, ends_group in merged_chunks(paths, recording.interleaved):
                writer.append(chunk, ends_group=ends_group)
        if recording.output.local is not None:
            bag.rename(recording.output.local)
        else:
            files = [path for path in bag.iterdir() if not path.name.startswith(".")]
            for path in sorted(files, key=lambda path: path.name == METADATA):
                recording.output.put(path, path.name)
    recording.folder.delete()


@contextmanager
def connected(address: str, workers: int | None) -> Iterator[Any]:
    """Ray, connected to a cluster, or to the one to which this process is connected already.

    Raises:
        BagError: Ray is not installed, or the address does not answer.
    """
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # or it warns of a change to come
    try:
        import ray
        import ray.exceptions
    except ImportError as reason:
        raise BagError(f"--ray needs Ray ({reason}); install it: pip install 'humansim_ros[ray]'") from None
    if ray.is_initialized():
        yield ray
        return
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
    if address == "local":
        options |= {"num_cpus": workers, "include_dashboard": False, "object_store_memory": _OBJECT_STORE}
        # workers import the package from the place from which this process has it
        places = [str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
        options["runtime_env"] = {"env_vars": {"PYTHONPATH": os.pathsep.join(places)}}
    else:
        _check_address(address)
    try:
        ray.init(address=address, **options)
    except (ConnectionError, ValueError, RuntimeError, OSError, ray.exceptions.RayError) as reason:
        text = str(reason).strip().splitlines()[0] if str(reason).strip() else type(reason).__name__
        raise BagError(f"Ray cannot be reached at this address: {text}", key=f"--ray {address}") from None
    try:
        yield ray
    finally:
        ray.shutdown()


def _check_address(address: str) -> None:
    """Check that a host answers: Ray itself would try for half a minute. Raises BagError."""
    parts = urlsplit(address if "://" in address else f"//{address}")
    if address == "auto":
        return
    try:
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if host is None or port is None or parts.scheme not in ("", "ray"):
        raise BagError("give local, auto, HOST:PORT or ray://HOST:PORT", key=f"--ray {address}")
    try:
        socket.create_connection((host, port), _CONNECT_LIMIT).close()
    except OSError as reason:
        raise BagError(
            f"Ray cannot be reached at this address: {reason.strerror or reason}", key=f"--ray {address}"
        ) from None
