"""Build of humansim_ros: a ROS 2 (ament_python) package that pip can install on its own as well."""

import sys
from collections.abc import Iterator
from pathlib import Path

from setuptools import Distribution, find_packages, setup

NAME = "humansim_ros"
# Resolved because colcon's symlink install runs a link to this file from its build folder.
ROOT = Path(__file__).resolve().parent
BUILDS_WHEEL = not {"bdist_wheel", "editable_wheel"}.isdisjoint(sys.argv)

COMMANDS = [
    "humansim = humansim_ros.cli.__main__:main",
    "motion_player = humansim_ros.ros.nodes.__main__:motion_player",
    "skinner = humansim_ros.ros.nodes.__main__:skinner",
    "scanner = humansim_ros.ros.nodes.__main__:scanner",
    "camera = humansim_ros.ros.nodes.__main__:camera",
    "camera_rig = humansim_ros.ros.nodes.__main__:camera_rig",
    "skinner_rig = humansim_ros.ros.nodes.__main__:skinner_rig",
    "evaluator = humansim_ros.ros.nodes.__main__:evaluator",
    "recorder = humansim_ros.ros.nodes.__main__:recorder",
    "bridge = humansim_ros.ros.nodes.__main__:bridge",
    "hri_bridge = humansim_ros.ros.nodes.__main__:hri_bridge",
]

# The upper bounds keep Ubuntu 24.04's own NumPy 1.26 in place: from these releases on, SciPy and OpenCV ask
# for NumPy 2, and pip would rather replace the system's NumPy than take an older wheel of them.
# imageio-ffmpeg 0.8 doubles the download (to 68 MB) for codecs nobody needs here.
REQUIRES = [
    "defusedxml>=0.7",
    "imageio-ffmpeg>=0.5,<0.8",
    "jinja2>=3.0",
    "moderngl>=5.8",
    "numpy>=1.26",
    "opencv-python-headless>=4.6,<4.12",
    "pydantic>=2.5",
    "pyyaml>=6.0",
    "rich>=13.0",
    "scipy>=1.11,<1.18",
    # tomllib of Python 3.11 and later
    "tomli>=2.0; python_version < '3.11'",
    "trimesh>=4.0",
    "typer>=0.19",
]

EXTRAS = {
    # Exactly these: without the pins pip mixes in Kilted wheels, and rclpy stops working.
    "ros": [
        "ros-jazzy-rclpy[fastrtps]==7.1.6",
        "ros-jazzy-common-interfaces==5.3.6",
        "mcap>=1.1",
        "rosbags>=0.10.6",
        # filters of simulation_interfaces
        "google-re2>=1.1",
    ],
    # writing and reading of bags; mcap brings zstandard and lz4
    "record": ["mcap>=1.1", "rosbags>=0.10.6"],
    # estimates in C3D files, in bags, and in images
    "evaluate": ["c3d>=0.6", "mcap>=1.1", "pycocotools>=2.0.7", "rosbags>=0.10.6"],
    # texture coordinates for bodies without any
    "photographs": ["xatlas>=0.0.9"],
    # the page of humansim view, with viser 1.1.1 tested; scene files that it edits
    "view": ["ruamel-yaml>=0.19", "viser>=1.1,<1.2"],
    # recording on a cluster, and to URLs; client is for addresses such as ray://host:10001
    "ray": ["fsspec>=2023.1", "mcap>=1.1", "ray[client]>=2.9", "rosbags>=0.10.6"],
    "test": [
        "bvhio",
        "c3d>=0.6",
        "colcon-common-extensions",
        "DracoPy>=1.5",
        "embreex",
        "ezc3d>=1.5",
        "fsspec>=2023.1",
        "hypothesis",
        "ipython>=8",
        "jsonschema>=4.17",
        "lxml>=4.9",
        "matplotlib>=3.8",
        "mcap>=1.1",
        "mkdocs-material>=9.5,<10",
        "mkdocs>=1.6,<2",
        "mkdocstrings[python]>=0.27",
        "mujoco>=3.2",
        "mypy",
        "networkx>=2.8",
        "OpenEXR>=3.3",
        "playwright>=1.40",
        "pycocotools>=2.0.7",
        "pycollada>=0.8",
        "pyrender==0.1.45",
        "pytest",
        "pytest-xdist",
        "ray>=2.9",
        "rosbags>=0.10.6",
        "ruff",
        # 70.1 builds wheels on its own; colcon needs an older one than 80
        "setuptools>=70.1,<80",
        "types-PyYAML",
        "types-defusedxml",
        "usd-core>=24.11",
        "webdataset>=0.2",
        "xatlas>=0.0.9",
    ],
    # glTF files with Draco compression
    "meshes": ["DracoPy>=1.5"],
    # panoramas of that kind
    "exr": ["OpenEXR>=3.3"],
    # formats of data sets (docs/export.md)
    "export": ["OpenEXR>=3.3", "c3d>=0.6", "mcap>=1.1", "pycocotools>=2.0.7", "usd-core>=24.11"],
    # recordings of Rerun (docs/export.md)
    "rerun": ["rerun-sdk>=0.41; python_version >= '3.11'"],
    # frame.plot()
    "plot": ["matplotlib>=3.8"],
    # tests with the fixtures of humansim_ros.testing
    "pytest": ["pytest"],
    # the other renderer
    "pyrender": ["pyrender==0.1.45"],
    "bench": ["pyrender==0.1.45"],
    # the site of the documentation (make docs)
    "docs": ["mkdocs>=1.6,<2", "mkdocs-material>=9.5,<10", "mkdocstrings[python]>=0.27"],
}


def files_below(folder: str) -> Iterator[Path]:
    """The files under a folder of the source tree, relative to the root of the tree."""
    for path in sorted((ROOT / folder).rglob("*")):
        if path.is_file() and path.suffix != ".pyc":
            yield path.relative_to(ROOT)


def shared(folder: str) -> list[tuple[str, list[str]]]:
    """Install a folder of the source tree, with its subfolders, under share/humansim_ros."""
    by_folder: dict[Path, list[str]] = {}
    for path in files_below(folder):
        by_folder.setdefault(path.parent, []).append(str(path))
    return [(f"share/{NAME}/{parent}", files) for parent, files in by_folder.items()]


def shims() -> tuple[str, list[str]]:
    """pip puts commands into bin/, colcon into lib/humansim_ros/: a script in the other place leads there."""
    if BUILDS_WHEEL:
        return (f"lib/{NAME}", [str(path) for path in files_below("resource/shims/lib")])
    return ("bin", [str(path) for path in files_below("resource/shims/bin")])


class DataDistribution(Distribution):
    """``pip install -e`` installs data files, too, so that ament finds the package.

    setuptools asks for ``has_data`` before it installs them into an editable wheel, and its own class has no
    such method.
    """

    def has_data(self) -> bool:
        """Whether there are data files."""
        return self.has_data_files()


setup(
    name=NAME,
    distclass=DataDistribution,
    # equal to package.xml; catkin_prepare_release needs the literal and raises both (docs/releasing.md)
    version="0.2.0",
    description="Synthetic ground truth of articulated humans for multi-camera trackers, over ROS 2",
    long_description=(ROOT / "README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    license="Apache-2.0 AND CC0-1.0 AND BSD-2-Clause AND BSD-3-Clause",
    license_files=["LICENSE", "LICENSES/*.txt"],
    maintainer="humansim_ros maintainers",
    maintainer_email="humansim-ros@example.org",
    classifiers=[
        "Development Status :: 4 - Beta",
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3",
        *(f"Programming Language :: Python :: 3.{minor}" for minor in (10, 11, 12, 13)),
        "Topic :: Scientific/Engineering :: Image Recognition",
        "Typing :: Typed",
    ],
    python_requires=">=3.10",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={
        NAME: [str(path.relative_to(NAME)) for path in files_below(NAME) if path.suffix != ".py"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *shared("config"),
        *shared("assets"),
        *shared("launch"),
        shims(),
    ],
    install_requires=REQUIRES,
    extras_require=EXTRAS,
    # under its full name, so that `-p` and `pytest_plugins` may name it, too
    entry_points={"console_scripts": COMMANDS, "pytest11": ["humansim_ros.testing = humansim_ros.testing"]},
    zip_safe=False,
)
