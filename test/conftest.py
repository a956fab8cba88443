"""Common fixtures, and the markers ``ros``, ``gl``, ``process`` and ``real_files`` of every test."""

from __future__ import annotations

import functools
import importlib.util
import os
import re
import signal
import sys
from collections import defaultdict
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import pytest

# Before NumPy is loaded: threads for small matrices cost five times their work where tests run in parallel.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

TESTS = Path(__file__).resolve().parent
ROOT = TESTS.parent
#: The fixtures that users have, and those that run pytest in a test.
pytest_plugins = ["humansim_ros.testing", "pytester"]
#: Markers of tests that use one of these names in their own code, a fixture, or a helper of this folder.
MARKED_BY_NAME = {
    "ros": {"SceneGraph", "humansim_graph", "create_node", "running_rclpy"},
    "gl": {
        "SceneGraph",
        "humansim_graph",
        "GLRenderer",
        "PyrenderRenderer",
        "Simulation",
        "make_renderer",
        "moderngl",
        "workshop",
    },
    "process": {"NodeProcesses", "multiprocessing", "runpytest_subprocess", "subprocess", "workshop"},
    "real_files": {"needs_shared_data", "shared_data"},
}
#: Real motions, meshes and calibrations: the folder of HUMANSIM_SHARED_DATA, or one beside the repository.
SHARED_DATA = Path(os.environ.get("HUMANSIM_SHARED_DATA") or ROOT.parent / "shared" / "data")

#: Shared motions and meshes for the nightly tests: a quicker shared file or a stand-in of their family is in
#: all tests.
MORE_OF_A_FAMILY = {
    "adakri_run", "aitviewer_sample", "alderson_contorsion", "animdraw_cmu1_jumping_jacks",
    "animdraw_rokoko_jesse_dance", "assimp_Boxing_Toes", "coda02_woman", "griebel_Example1", "loadbvh_test",
    "makehuman_tpose", "mh2007_female_A_dm.obj", "mh2007_male_T_dm.obj", "mocapbank_bvhpython",
    "tomboudard_walkSit",
}  # fmt: skip

#: Modules that only tests import. Tests that need a missing one are skipped: rosdep does not have all of
#: them, and `colcon test` has to pass without.
TEST_PACKAGES = {
    "DracoPy", "OpenEXR", "OpenGL", "bvhio", "c3d", "catkin_pkg", "collada", "colcon_core", "embreex",
    "ezc3d", "fsspec", "hypothesis", "lxml", "mcap", "mypy", "networkx", "pycollada", "pyrender", "ray",
    "playwright", "rosbags", "rtree", "viser",
}  # fmt: skip

with suppress(ImportError):
    import hypothesis

    # examples take longer on a loaded machine: that is no failure
    hypothesis.settings.register_profile(
        "patient", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
    )
    hypothesis.settings.load_profile("patient")

needs_shared_data = pytest.mark.skipif(
    not SHARED_DATA.is_dir(), reason=f"no shared files at {SHARED_DATA} (HUMANSIM_SHARED_DATA)"
)


def if_shared(*values: Any) -> list[Any]:
    """Parameters of a test that are shared files: none if the folder is missing, so that nothing is skipped.

    The other parameters are stand-ins, of which the same is shown (test/stand_ins.py).
    """
    rows = [each if isinstance(each, tuple) else (each,) for each in values]
    marked = [pytest.param(*row, marks=[needs_shared_data, *_nightly(row[0])]) for row in rows]
    return marked if SHARED_DATA.is_dir() else []


def _nightly(name: Any) -> list[pytest.MarkDecorator]:
    return [pytest.mark.nightly] * (isinstance(name, str) and name in MORE_OF_A_FAMILY)


def shared_motions(*without: str) -> list[Any]:
    """Names of the shared BVH files as parameters of a test, but those that its claim is not about.

    Empty if the folder is missing.
    """
    names = sorted(path.stem for path in (SHARED_DATA / "bvh").glob("*.bvh") if path.stem not in without)
    return [pytest.param(name, marks=[needs_shared_data, *_nightly(name)]) for name in names]


def pytest_configure() -> None:
    """Let SIGTERM, as of ``timeout``, interrupt tests as Ctrl-C does: they stop what they have started."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    is_whole = not any("[" in argument for argument in config.args)
    _mark_nightly_cases([item for item in items if isinstance(item, pytest.Function)], is_whole)
    for item in items:
        if not isinstance(item, pytest.Function):
            continue  # a doctest
        fixtures = [each.func for defs in item._fixtureinfo.name2fixturedefs.values() for each in defs]
        parameters = item.callspec.params.values() if hasattr(item, "callspec") else ()
        names = {"needs_shared_data"} if needs_shared_data.mark in item.iter_markers("skipif") else set()
        names = names.union(item.fixturenames, *map(_names, (item.function, *fixtures, *parameters)))
        for marker, triggers in MARKED_BY_NAME.items():
            if names & triggers:
                item.add_marker(marker)


def _mark_nightly_cases(items: list[pytest.Function], is_whole: bool) -> None:
    """Mark cases as nightly that ``pytest.mark.daily`` of their test does not name.

    Raises pytest.UsageError for a name without a case, if ``is_whole``: all cases of each test are there.
    """
    unused: dict[tuple[Path, str], set[str]] = {}
    for item in items:
        for marker in item.iter_markers("daily"):
            unused.setdefault((item.path, item.function.__name__), set(marker.args))
            used = {name for name in marker.args if fnmatchcase(item.callspec.id, name)}
            unused[item.path, item.function.__name__] -= used
            if not used:
                item.add_marker("nightly")
    for (path, test), names in unused.items():
        if names and is_whole:
            raise pytest.UsageError(f"{path}: {test} has no case {', '.join(sorted(names))}")


@pytest.hookimpl(hookwrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Generator[None, Any, None]:
    """Skip modules that import a missing package of the tests."""
    report = (yield).get_result()
    if isinstance(collector, pytest.Module):
        _skip_without_package(report, collector.path)


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, Any, None]:
    """Skip tests that import a missing package of the tests."""
    _skip_without_package((yield).get_result(), item.path)


def _skip_without_package(report: Any, path: Path) -> None:
    if not report.failed:
        return
    error = getattr(getattr(report.longrepr, "reprcrash", None), "message", None) or str(report.longrepr)
    # the other message is trimesh's
    found = re.search(r"No module named '(\w+)|ImportError: missing `pip install (\w+)`", error)
    missing = found and (found[1] or found[2])
    if missing in TEST_PACKAGES:
        report.outcome = "skipped"
        reason = f"Skipped: {missing} is not installed (pip install '.[test]' installs what tests need)"
        report.longrepr = (str(path), 0, reason)


def _names(value: Any) -> set[str]:
    """Names and strings in the code of a function of this folder, and of the helpers that it calls."""
    return set().union(*map(_names_of_function, _functions(value)))


@functools.cache
def _names_of_function(function: FunctionType) -> set[str]:
    visited, names, pending = set(), set(), [function]
    while pending:
        each = pending.pop()
        if each not in visited:
            visited.add(each)
            names |= _words(each.__code__)
            pending += _called(each)
    return names


@functools.cache
def _called(function: FunctionType) -> list[FunctionType]:
    known = function.__globals__
    return [called for word in _words(function.__code__) & known.keys() for called in _functions(known[word])]


def _functions(value: Any) -> list[FunctionType]:
    """The function itself, or the methods of a class, if they are defined in this folder; else nothing."""
    value = getattr(value, "__wrapped__", value)
    if isinstance(value, type):
        return [f for each in list(vars(value).values()) for f in _functions(each)]
    if isinstance(value, FunctionType) and value.__code__.co_filename.startswith(str(TESTS)):
        return [value]
    return []


@functools.cache
def _words(code: CodeType) -> frozenset[str]:
    inner = [_words(each) for each in code.co_consts if isinstance(each, CodeType)]
    return frozenset(code.co_names).union(
        (c.partition(".")[0] for c in code.co_consts if isinstance(c, str)), *inner
    )


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real files; skips the test if it is missing."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"no shared files at {SHARED_DATA} (HUMANSIM_SHARED_DATA)")
    return SHARED_DATA


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Write humans of the tests into a temporary cache, not into the cache of the user.

    The processes of pytest-xdist share it, so that a human is made once in a run.
    """
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HUMANSIM_CACHE", str(folder / "humans"))
        yield


@pytest.fixture(scope="session", autouse=True)
def built_in_humans_once() -> Iterator[None]:
    """Read each human of the package once in a process: humans are never changed."""
    from humansim_ros.people.loading import loading

    read, known = loading.read_human, {}

    def read_once(path: Any) -> Any:
        if Path(path).parent != ROOT / "assets" / "humans":
            return read(path)
        if path not in known:
            known[path] = read(path)
        return known[path]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loading, "read_human", read_once)
        yield


@pytest.fixture
def no_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    """No human is kept."""
    monkeypatch.setenv("HUMANSIM_CACHE", "off")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache of humans."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("HUMANSIM_CACHE", str(folder))
    return folder


@pytest.fixture
def figure(tmp_path: Path) -> Path:
    """A glTF file of a person with bones."""
    import figures

    path = tmp_path / "figure.glb"
    path.write_bytes(figures.glb(*figures.gltf()))
    return path


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """Chromium, for the tests of one file."""
    from pages import browser

    with browser() as opened:
        yield opened


@pytest.fixture(scope="session")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Makes small recordings, exports and data sets, which the tests of the engine interrupt."""
    from workshop import open_workshop

    with open_workshop(tmp_path_factory.mktemp("workshop")) as opened:
        yield opened


@pytest.fixture(scope="session")
def assets() -> Path:
    """Folder of the humans and motions of the package."""
    return ROOT / "assets"


@pytest.fixture(scope="module")
def ros() -> Iterator[None]:
    """Initialise rclpy with a transport for images, for the tests of one file.

    No other player is in their domain: those in this process do not look for one for two seconds.
    """
    from humansim_ros.ros.playing import lockstep as playing
    from humansim_ros.ros.tools import bag_player
    from humansim_ros.testing.support import running_rclpy

    with running_rclpy(), pytest.MonkeyPatch.context() as patch:
        for module in (bag_player, playing):
            patch.setattr(module, "CLOCK_SEARCH", 0.0)
        yield


@functools.cache
def built_package(name: str) -> Path:
    """Folder with a Python package of messages that is not on PyPI; the test is skipped without compiler.

    The variable ``SIMULATION_INTERFACES`` chooses a version of that package: ``simulation_interfaces-2.1``.
    """
    if name == "simulation_interfaces":
        name = os.environ.get("SIMULATION_INTERFACES", name)
    spec = importlib.util.spec_from_file_location("build_interfaces", ROOT / "tools" / "build_interfaces.py")
    assert spec is not None and spec.loader is not None
    build_interfaces = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(build_interfaces)
    try:
        return Path(build_interfaces.built_interfaces(name))
    except build_interfaces.BuildError as reason:
        pytest.skip(f"interfaces cannot be built here: {reason}")


@contextmanager
def importable(*packages: str) -> Iterator[None]:
    """Context in which built packages of messages can be imported."""
    from humansim_ros.data.messages import types

    folders = [str(built_package(name)) for name in packages]
    sys.path[:0] = folders
    types._is_message_package.cache_clear()
    yield
    for folder in folders:
        sys.path.remove(folder)
    for name in [name for name in sys.modules if name.partition(".")[0] in packages]:
        del sys.modules[name]
    types._is_message_package.cache_clear()


@pytest.fixture(scope="session")
def built_interfaces() -> Path:
    """Folder with the Python package simulation_interfaces."""
    return built_package("simulation_interfaces")


@pytest.fixture(scope="module")
def interfaces(built_interfaces: Path) -> Iterator[Path]:
    """The built package can be imported, in the tests of one file."""
    with importable("simulation_interfaces"):
        yield built_interfaces


@pytest.fixture
def tf(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[Any]]:
    """Messages of nodes on /tf and /tf_static; tf2_msgs, which is not on PyPI, may be absent."""
    from humansim_ros.ros.processes import transforms
    from humansim_ros.ros.processes.node import SceneNode

    sent: dict[str, list[Any]] = defaultdict(list)

    class Recorder:
        def __init__(self, topic: str) -> None:
            self.topic = topic

        def publish(self, message: Any) -> None:
            sent[self.topic].append(message.transforms)

    class Transforms:
        def __init__(self, transforms: Any = ()) -> None:
            self.transforms = list(transforms)

    publisher = SceneNode.create_publisher

    def create(node: Any, kind: Any, topic: str, qos: Any, **options: Any) -> Any:
        return Recorder(topic) if kind is Transforms else publisher(node, kind, topic, qos, **options)

    monkeypatch.setattr(transforms, "TFMessage", Transforms)
    monkeypatch.setattr(SceneNode, "create_publisher", create)
    return sent


@pytest.fixture(params=["stand-in", pytest.param("ray", marks=pytest.mark.nightly)])
def cluster(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Ray for ``--ray local``: a stand-in that does each task here; in the nightly tests Ray itself."""
    if request.param == "ray":
        request.getfixturevalue("workers")
        yield
        return
    import ray_stand_in

    from humansim_ros.data.engine import pool, writing

    monkeypatch.setattr(pool, "connected", ray_stand_in.connected)
    monkeypatch.setattr(pool, "_ONE_CORE", {})  # variables of this process
    yield
    writing._opened.cache_clear()


@pytest.fixture(scope="session")
def workers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A local Ray with three workers; yields the folder for temporary files of the workers."""
    ray = pytest.importorskip("ray")
    folder = tmp_path_factory.mktemp("workers")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", f"{ROOT}{os.pathsep}{TESTS / 'engine'}")
        patch.setenv("RAY_TMPDIR", "/tmp")  # its sockets must have short names
        patch.setenv("TMPDIR", str(folder))
        patch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        options = {"object_store_memory": 80 * 2**20, "include_dashboard": False}
        ray.init(num_cpus=3, log_to_driver=False, logging_level="error", **options)
    yield folder
    ray.shutdown()
