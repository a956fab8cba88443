"""``humansim check``: find probable mistakes in a scene that loads."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from humansim_ros.cli.options import JsonOption
from humansim_ros.cli.output import print_text, print_warning, to_json

if TYPE_CHECKING:
    from humansim_ros.cli.scene_options import SceneOptions
    from humansim_ros.scene import Scene


def check(
    scene: Annotated[Path | None, typer.Argument(help="Scene file (YAML); the demo scene if absent.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Find probable mistakes in a scene: cameras that see nobody, people in walls … Exit code 1 if any."""
    from humansim_ros.scene import Scene, check_scene

    loaded = Scene.load(scene)
    findings = check_scene(loaded)
    if as_json:
        data: dict[str, Any] = {"scene": str(loaded.path), "findings": [each.to_dict() for each in findings]}
        print_text(to_json(data))
    else:
        lines = [f"{finding.severity}: {finding}" for finding in findings]
        counts = f"{_count(len(loaded.cameras), 'camera')}, {_count(len(loaded.actors), 'human')}"
        problems = _count(len(findings), "problem") if findings else "no problems"
        print_text("\n".join([*lines, f"{loaded.path}: {problems} found ({counts})"]))
    if findings:
        raise typer.Exit(1)


def warn_about_mistakes(scene: Scene, options: SceneOptions | None = None) -> None:
    """Print the findings of a quick check as warnings, for commands that play a scene.

    ``options``: options that have replaced parts of the scene.
    """
    from humansim_ros.scene import check_scene

    human = next(iter(scene.actors), "")
    for finding in check_scene(scene, quick=True):
        option = None if options is None else options.option(human, finding.key)
        print_warning(str(finding) if option is None else f"{option}: {finding.text}")


def _count(number: int, word: str) -> str:
    return f"{number} {word}{'' if number == 1 else 's'}"
