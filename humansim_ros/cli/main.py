"""The ``humansim`` command.

Exit codes: 0 success; 1 a check or run failed; 2 wrong input or command; 3 a worker died, and 4 the disk is
full: the same command with ``--resume`` continues; 128 + number of the signal after a stop.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperGroup

from humansim_ros.cli.options import join_numbers, new_names, with_options
from humansim_ros.cli.output import (
    flush_errors,
    flush_output,
    give_up_output,
    print_error,
    print_text,
    print_warning,
)
from humansim_ros.errors import HumansimError, printable, show_warnings

#: Module and function of each command, in the order of the help text.
COMMANDS = {
    "run": "run:run",
    "check": "scene:check",
    "snapshot": "scene:snapshot",
    "view": "view:view",
    "doctor": "doctor:doctor",
    "schema": "scene:schema",
    "demo": "run:demo",
    "bench": "run:bench",
    "record": "record:record",
    "export": "export:export",
    "play": "run:play",
    "evaluate": "evaluate:evaluate",
    "challenge": "evaluate:challenge",
    "camera show": "camera:show",
    "camera convert": "camera:convert",
    "camera idealize": "camera:idealize",
    "camera rig": "camera:rig",
    "camera plot": "camera:plot",
    "camera place": "camera_place:place",
    "human list": "human:list_humans",
    "human joints": "human:joints",
    "human show": "human:show",
    "human info": "human:info",
    "human build": "human:build",
    "human make": "human:make",
    "human rig": "human:rig",
    "human fit": "human:fit",
    "human texture": "human:texture",
    "mesh list": "scene:list_meshes",
    "motion info": "motion:info",
    "motion joints": "motion:joints",
    "motion retarget": "motion:retarget",
    "motion table": "motion:table",
    "motion list": "motion:list_motions",
    "motion render": "motion:render",
}
#: Help text of each group of commands.
GROUPS = {
    "camera": "Read, convert, place and draw calibrations; arrange cameras to rigs.",
    "human": "List, draw, build, make, rig, fit and texture humans.",
    "mesh": "List the built-in meshes for objects.",
    "motion": "Describe, match, retarget and draw motions.",
}
#: Headings of the help text, with their commands and groups.
HEADINGS = {
    "Run and view": ("run", "demo", "view", "snapshot"),
    "Scenes and this machine": ("check", "schema", "doctor", "bench"),
    "Data sets and bags": ("record", "play", "export"),
    "Trackers": ("evaluate", "challenge"),
    "Cameras, humans and motions": ("camera", "human", "motion", "mesh"),
}
#: Accept ``-h`` as well as ``--help``.
_SETTINGS = {"help_option_names": ["-h", "--help"]}
#: Environment variable by which a shell asks for completions.
_COMPLETION = "_HUMANSIM_COMPLETE"


def _root(version: bool = False) -> None:
    if version:
        from humansim_ros import __version__

        print_text(__version__)
        raise typer.Exit


class _Headed(TyperGroup):
    """The command, with its subcommands listed below headings."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands of each heading with their short help."""
        # as wide as the longest name, so that the columns of all headings agree
        width = max(map(len, self.commands), default=0)
        for heading, names in HEADINGS.items():
            rows = [
                (name.ljust(width), self.commands[name].get_short_help_str(formatter.width - width - 6))
                for name in names
                if name in self.commands
            ]
            if rows:
                with formatter.section(heading):
                    formatter.write_dl(rows)


def load_command(name: str) -> Callable[..., None]:
    """Import the function of a command, such as ``camera show``, with its options."""
    module, _, function = COMMANDS[name].partition(":")
    return with_options(name, getattr(import_module(f"humansim_ros.cli.{module}"), function))


def make_app(arguments: Sequence[str] | None = None) -> typer.Typer:
    """Make the command with its subcommands. ``arguments``: the command line. Only the subcommands that it
    may mean are loaded, which halves the time of the start. If None, all are loaded."""
    app = typer.Typer(
        cls=_Headed,
        help="Synthetic ground truth of articulated humans for multi-camera trackers, over ROS 2.",
        context_settings=_SETTINGS,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,  # rich takes longer to import than everything else
    )
    app.callback(invoke_without_command=True)(with_options("humansim", _root))
    named = next((word for word in arguments or () if not word.startswith("-")), None)
    known = named in GROUPS or named in COMMANDS
    for name in COMMANDS:
        if " " not in name and (name == named or not known):
            app.command(name)(load_command(name))
    for group, text in GROUPS.items():
        if known and named != group:
            continue
        subcommands = typer.Typer(help=text, no_args_is_help=True, rich_markup_mode=None)
        for name in COMMANDS:
            if name.startswith(f"{group} ") and (arguments is None or named == group):
                subcommands.command(name.split()[1])(load_command(name))
        app.add_typer(subcommands, name=group)
    return app


def _parser_message(error: Any) -> str:
    """Text of an error of the command-line parser, with the command that prints help."""
    message = str(error.format_message()).replace("Value error, ", "")
    if type(error).__name__ == "NoArgsIsHelpError":
        return message
    context = getattr(error, "ctx", None)
    return (
        f"error: {message.rstrip('.')}; see `{context.command_path} --help`"
        if context
        else f"error: {message}"
    )


def _unexpected(error: Exception) -> str:
    """One line about an unexpected error, which is a fault of this program."""
    last = traceback.extract_tb(error.__traceback__)[-1:]
    where = "".join(f" ({Path(frame.filename).name}:{frame.lineno})" for frame in last)
    return (
        f"{type(error).__name__}: {printable(str(error))}{where}; this is a fault of humansim: please report "
        "it with the output of the same command after HUMANSIM_TRACEBACK=1"
    )


def main(arguments: Sequence[str] | None = None, stopped: Callable[[], int | None] = lambda: None) -> int:
    """Run a command and return its exit code: 2 for errors of the package, 1 for others.

    An error prints one line to standard error; with HUMANSIM_TRACEBACK=1, also the traceback. After a stop
    signal, a command cleans up and ends with exit code 128 + signal number, a run of all nodes with 0.

    Args:
        arguments: Words after ``humansim``. If None, the words of this process.
        stopped: Function that returns the number of the stop signal that has arrived, or None.
    """
    show_warnings()
    given = sys.argv[1:] if arguments is None else arguments
    try:
        arguments = join_numbers(new_names(given, print_warning))
        # a shell that asks for completions passes the words in variables
        app = make_app(None if _COMPLETION in os.environ else arguments)
        result = app(arguments, prog_name="humansim", standalone_mode=False)
        flush_output()
    except HumansimError as error:
        print_error(f"error: {error}")
        return error.exit_code
    except typer.Abort as abort:
        if isinstance(abort.__cause__, EOFError):  # typer makes an Abort of it, as of the end of a terminal
            print_error(f"error: {_unexpected(abort.__cause__)}")
        return 1
    except OSError as error:
        give_up_output()  # the help of commands is written without print_text
        where = f"{error.filename}: " if error.filename else ""
        print_error(f"error: {where}{error.strerror or error}")
        return 1
    except MemoryError as error:
        print_error(f"error: out of memory{f' ({error})' if str(error) else ''}")
        return 1
    except Exception as error:
        if (
            number := stopped()
        ) is not None:  # a library has made another exception of Stopped, as pydantic does
            return 128 + number
        if hasattr(error, "format_message") and hasattr(
            error, "exit_code"
        ):  # an error of the command-line parser
            print_error(_parser_message(error))
            return 2
        print_error(f"error: {_unexpected(error)}")
        return 1
    finally:
        flush_errors()
    return result if isinstance(result, int) else 0  # typer.Exit returns its code here
