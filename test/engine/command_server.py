"""A process that runs the command ``humansim`` in copies of itself.

A new process needs seconds to import the package; a copy of this one has done so. Requests are lines of JSON
on standard input, answers are lines of JSON on standard output:

- ``{"modules": [...]}`` imports modules. The answer is null.
- ``{"words": [...], "environment": {...}, "output": PATH, "largest_file": BYTES}`` starts a command in a new
  session. The answer is its process id. Its standard output and standard error go to ``PATH.out`` and
  ``PATH.err``. Files may have at most ``largest_file`` bytes, if it is not null.
- ``{"wait": PID}`` answers with the exit code, or null if the command has not ended. It is negative if
  the command was killed.
"""

from __future__ import annotations

import json
import os
import resource
import sys
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import stop_hook


def _run(request: dict[str, Any]) -> int:
    """Run a command in this copy of the process."""
    os.setsid()
    for number, suffix in ((1, "out"), (2, "err")):
        file = os.open(f"{request['output']}.{suffix}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(file, number)
        os.close(file)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.environ.update(request["environment"])
    if (size := request["largest_file"]) is not None:
        sys.dont_write_bytecode = True  # it would be cut, and Python would not notice
        os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    stop_hook.install(is_main=True)
    sys.argv[1:] = request["words"]
    from humansim_ros.cli.__main__ import main

    code = main()
    if (listed := os.environ.get("HUMANSIM_TEST_MODULES")) is not None:
        Path(listed).write_text("\n".join(name for name in list(sys.modules) if not name.startswith("ray")))
    return code


def _answer(request: dict[str, Any]) -> int | None:
    if "modules" in request:
        for name in request["modules"]:
            with suppress(ImportError):
                import_module(name)
        return None
    found, status = os.waitpid(request["wait"], os.WNOHANG)
    return os.waitstatus_to_exitcode(status) if found else None


def _serve() -> int:
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    for line in sys.stdin:
        request = json.loads(line)
        if "words" in request:
            result: int | None = os.fork()
            if not result:
                answers.detach()
                return _run(request)
        else:
            result = _answer(request)
        print(json.dumps(result), file=answers, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(_serve())
