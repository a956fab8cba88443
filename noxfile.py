"""Checks in environments of their own: `pip install nox`, then `nox --list`, `nox -s lint` and so on.

The workflow of .github/workflows/ci.yml runs these sessions. Arguments after `--` go to pytest:
`nox -s "tests(python='3.11', numpy='1.26')" -- -k lens`. Sessions install the versions of constraints.txt;
only `newest` takes the newest releases, and its failure blocks nothing.
"""

from __future__ import annotations

from pathlib import Path

import nox

nox.options.sessions = ["lint", "tests", "no_ros", "colcon", "dist"]
nox.options.default_venv_backend = "venv"

PYTHONS = ("3.10", "3.11", "3.12", "3.13")
#: NumPy 1.26 is the version of Ubuntu 24.04, so of ROS 2 Jazzy. It has no wheels for Python 3.13.
#: NumPy 2 comes from constraints.txt.
NUMPYS = {"1.26": "numpy==1.26.*", "2": ""}
COMBINATIONS = [
    (python, numpy) for python in PYTHONS for numpy in NUMPYS if (python, numpy) != ("3.13", "1.26")
]


def install(session: nox.Session, extras: str, numpy: str = "") -> None:
    """Install the package with the versions of constraints.txt, or with another NumPy."""
    lines = Path("constraints.txt").read_text(encoding="utf-8").splitlines()
    constraints = Path(session.create_tmp()) / "constraints.txt"
    if numpy:
        lines = [line for line in lines if not line.startswith("numpy==")]
    constraints.write_text("\n".join([*lines, numpy, ""]), encoding="utf-8")
    pins = {"PIP_CONSTRAINT": str(constraints), "PIP_BUILD_CONSTRAINT": str(constraints)}
    session.install("-e", f".[{extras}]", env=pins)


def run_tests(session: nox.Session) -> None:
    """Run pytest as `make test` does, or once with the arguments of the session."""
    pytest = ("python", "-m", "pytest")
    if session.posargs:
        session.run(*pytest, *session.posargs)
        return
    session.run(*pytest, "-n", "auto", "-m", "not ros and not process and not nightly")
    session.run(*pytest, "-n", "2", "--dist", "loadfile", "-m", "(ros or process) and not nightly", "test")


@nox.session
@nox.parametrize("python,numpy", COMBINATIONS)
def tests(session: nox.Session, numpy: str) -> None:
    """All tests, with ROS from PyPI, on each Python with each major version of NumPy."""
    install(session, "ros,view,test", NUMPYS[numpy])
    run_tests(session)


@nox.session(python=PYTHONS)
def no_ros(session: nox.Session) -> None:
    """The tests that need no ROS, where rclpy is not installed."""
    install(session, "test")
    session.run("python", "-c", "import importlib.util as i; assert i.find_spec('rclpy') is None")
    session.run("python", "-m", "pytest", "-n", "auto", "-m", "not ros and not nightly", *session.posargs)


@nox.session(python=("3.10", "3.13"))
def newest(session: nox.Session) -> None:
    """Types and tests with the newest releases of all packages. A failure blocks nothing."""
    session.install("-e", ".[ros,view,test]")
    session.run("mypy", success_codes=range(256))
    run_tests(session)


@nox.session(python="3.12")
def colcon(session: nox.Session) -> None:
    """colcon builds the package, copied and symlinked, and the result runs. The Python is that of Jazzy."""
    install(session, "ros,view,test", NUMPYS["1.26"])
    session.run("python", "-m", "pytest", "-k", "colcon", *(session.posargs or ["test"]))


@nox.session
def lint(session: nox.Session) -> None:
    """Format, lint and types."""
    install(session, "test")
    session.run("ruff", "format", "--check", ".")
    session.run("ruff", "check", ".")
    session.run("mypy")


@nox.session
def dist(session: nox.Session) -> None:
    """Build wheel and sdist, check them, install each in an environment of its own and run the demo there."""
    session.run("tools/check_dist.sh", external=True)
