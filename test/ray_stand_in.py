"""A stand-in for Ray that does each task in this process, at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any


class TaskError(Exception):
    """A task has failed, as ``ray.exceptions.RayError``. ``cause``: its exception."""

    def __init__(self, cause: Exception) -> None:
        super().__init__(str(cause))
        self.cause = cause


class RayStandIn:
    """The functions of Ray that this package uses."""

    exceptions = SimpleNamespace(RayError=TaskError)

    def put(self, value: Any) -> Any:
        return value

    def remote(self, **_: Any) -> Callable[[Callable[..., Any]], Any]:
        return lambda function: SimpleNamespace(remote=lambda *words: _Done(function, words))

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 1}

    def wait(self, references: list[Any], **_: Any) -> tuple[list[Any], list[Any]]:
        return references, []

    def get(self, reference: _Done) -> Any:
        if reference.error is not None:
            raise TaskError(reference.error)
        return reference.value


class _Done:
    def __init__(self, function: Callable[..., Any], words: tuple[Any, ...]) -> None:
        self.error: Exception | None = None
        try:
            self.value = function(*words)
        except Exception as error:
            self.error = error


@contextmanager
def connected(address: str, workers: int | None) -> Iterator[RayStandIn]:
    """Take the place of ``ray_cluster.connected``."""
    yield RayStandIn()
