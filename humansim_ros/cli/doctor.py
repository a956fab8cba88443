"""``humansim doctor``: what is wrong with this machine; ``humansim schema``: the schema of scene files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from humansim_ros.cli.output import check_output, print_text, report_write_errors, to_json

_MARKS = {"ok": "ok     ", "warning": "warning", "wrong": "WRONG  "}


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for programs.")] = False,
) -> None:
    """Check this machine (OpenGL, ROS, DDS, shared memory …), and print the line that mends what is wrong."""
    from humansim_ros.cli.doctor_checks import diagnoses

    found = []
    for finding in diagnoses():
        found.append(finding)
        if not as_json:
            print_text(f"{_MARKS[finding.state]}  {finding.name}: {finding.text}")
            if finding.fix:
                print_text(f"           → {finding.fix}")
    if as_json:
        print_text(to_json([asdict(finding) for finding in found]))
    if any(finding.state == "wrong" for finding in found):
        raise typer.Exit(1)


def schema(
    output: Annotated[Path | None, typer.Option("--output", "-o", help="File to write (.json).")] = None,
) -> None:
    """Print the JSON schema of scene files, for editors that complete and check YAML."""
    from humansim_ros.scene.schema import schema_text

    text = schema_text()
    if output is None:
        print_text(text.rstrip())
        return
    check_output(output)
    with report_write_errors(output):
        output.write_text(text, encoding="utf-8")
    print_text(f"wrote {output}")


#: Commands of this module by name.
COMMANDS: dict[str, Callable[..., None]] = {"doctor": doctor, "schema": schema}
