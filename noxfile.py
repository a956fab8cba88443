"""Checks in environments of their own: `pip install nox`, then `nox --list`, `nox -s lint` and so on.

The workflow of .github/workflows/ci.yml runs these sessions. Arguments after `--` go to pytest:
`nox -s "tests(python='3.11', numpy='1.26')" -- -k lens`.
"""

from __future__ import annotations

import nox

nox.options.sessions = ["lint", "tests", "no_ros", "colcon", "dist"]
nox.options.default_venv_backend = "venv"

PYTHONS = ("3.10", "3.11", "3.12", "3.13")
#: NumPy 1.26 is the version of Ubuntu 24.04, so of ROS 2 Jazzy. It has no wheels for Python 3.13.
NUMPYS = {"1.26": "numpy==1.26.*", "2": "numpy>=2"}
COMBINATIONS = [
    (python, numpy) for python in PYTHONS for numpy in NUMPYS if (python, numpy) != ("3.13", "1.26")
]


def run_tests(session: nox.Session) -> None:
    """Run pytest as `make test` does, or once with the arguments of the session."""
    pytest = ("python", "-m", "pytest")
    if session.posargs:
        session.run(*pytest, *session.posargs)
        return
    session.run(*pytest, "-n", "auto", "-m", "not ros and not process")
    session.run(*pytest, "-m", "ros or process")


@nox.session
@nox.parametrize("python,numpy", COMBINATIONS)
def tests(session: nox.Session, numpy: str) -> None:
    """All tests, with ROS from PyPI, on each Python with each major version of NumPy."""
    session.install("-e", ".[ros,view,test]", NUMPYS[numpy])
    run_tests(session)


@nox.session(python=PYTHONS)
def no_ros(session: nox.Session) -> None:
    """The tests that need no ROS, where rclpy is not installed."""
    session.install("-e", ".[test]")
    session.run("python", "-c", "import importlib.util as i; assert i.find_spec('rclpy') is None")
    session.run("python", "-m", "pytest", "-n", "auto", "-m", "not ros", *session.posargs)


@nox.session(python="3.12")
def colcon(session: nox.Session) -> None:
    """colcon builds the package, copied and symlinked, and the result runs. The Python is that of Jazzy."""
    session.install("-e", ".[ros,view,test]", NUMPYS["1.26"])
    session.run("python", "-m", "pytest", "-k", "colcon", *(session.posargs or ["test"]))


@nox.session
def lint(session: nox.Session) -> None:
    """Format, lint and types."""
    session.install("-e", ".[test]")
    session.run("ruff", "format", "--check", ".")
    session.run("ruff", "check", ".")
    session.run("mypy")


@nox.session
def dist(session: nox.Session) -> None:
    """Build wheel and sdist, check them, install each in an environment of its own and run the demo there."""
    session.run("tools/check_dist.sh", external=True)
