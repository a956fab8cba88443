"""``humansim check``, ``snapshot``, ``schema`` and ``mesh list``: commands about scenes.

The module also has the options of other commands that replace parts of a scene.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from humansim_ros.cli.output import check_output, print_text, print_warning, to_json
from humansim_ros.errors import HumansimError, unknown
from humansim_ros.files.reading import exists, expand_user, write_file

if TYPE_CHECKING:
    from humansim_ros.scene.core import Scene


@dataclass(frozen=True)
class SceneOptions:
    """Options that replace parts of a scene.

    Attributes:
        motion: Motion file or built-in motion of the first human. The motion is placed in the centre of the
            room.
        body: Body of the first human.
        joint_names: Joint table for ``motion``.
        live: Names of humans that get their motion live, from another node.
    """

    motion: str | None = None
    body: str | None = None
    joint_names: str | None = None
    live: Sequence[str] = ()

    def __bool__(self) -> bool:
        return bool(self.motion or self.body or self.joint_names or self.live)

    def write(self, path: Path, folder: Path) -> Path:
        """Write a copy of a scene with the replaced parts. Raises HumansimError.

        ``folder``: folder of the copy.
        """
        import yaml

        from humansim_ros.errors import SceneError
        from humansim_ros.scene.config import LIVE, load_config, map_files
        from humansim_ros.scene.core import SceneSource, begin_draft, found_name
        from humansim_ros.scene.features import Variety

        source, scene = SceneSource.of_file(path), load_config(path)
        if scene.variety is not None:
            with source.locating_errors():
                draft = begin_draft(scene, source)
                Variety().expand(draft)
            scene = draft.config
        config = map_files(scene.model_dump(exclude_none=True), lambda name: found_name(source.folder, name))
        config.setdefault("room", None)
        humans = config["humans"]
        if not humans:
            raise SceneError("the scene has no human to give a motion or body to", path=path, key="humans")
        for name in self.live:
            if name not in humans:
                raise SceneError(unknown("human", name, humans, "the scene"), path=path, key="--live")
            place = humans[name]["motion"]
            humans[name]["motion"] = {
                "file": LIVE,
                "position": place["position"],
                "yaw_deg": place["yaw_deg"],
            }
        human = next(iter(humans.values()))
        if self.body:
            human["body"] = _absolute(self.body)
            human.pop("outfit", None)
        if self.motion:
            human["motion"] = {"file": _absolute(self.motion), "anchor": "center"}
        if self.joint_names:
            human["motion"]["joint_names"] = _absolute(self.joint_names)
        changed = folder / path.name
        changed.write_text(yaml.safe_dump(config, sort_keys=False))
        return changed

    def load(self, path: Path, changed: Path) -> Scene:
        """Load ``changed``, the copy of the scene ``path``. Errors name the option, or line of ``path``."""
        from humansim_ros.scene.config import load_config
        from humansim_ros.scene.core import Scene, SceneSource

        config = load_config(changed)
        with self.naming_options(next(iter(config.humans))):
            return Scene.from_config(config, SceneSource.of_file(path))

    def option(self, human: str, key: str) -> str | None:
        """Name of the option that has replaced a key of the scene; None if no option has. ``human``: name of
        the first human."""
        section = f"humans.{human}."
        given = {
            f"{section}motion.joint_names": ("--joint-names", self.joint_names),
            f"{section}motion": ("--motion", self.motion),
            f"{section}body": ("--body", self.body),
            f"{section}outfit": ("--body", self.body),
        }
        replaced = (name for start, (name, value) in given.items() if value and _begins(key, start))
        live = ("--live" for name in self.live if _begins(key, f"humans.{name}.motion"))
        return next(replaced, None) or next(live, None)

    @contextmanager
    def naming_options(self, human: str) -> Iterator[None]:
        """Context manager: errors within it about a replaced value name the option."""
        try:
            yield
        except HumansimError as error:
            option = None if error.key is None else self.option(human, error.key)
            if option is None:
                raise
            raise type(error)(error.message, key=option) from error.__cause__


def _begins(key: str, start: str) -> bool:
    return f"{key}.".startswith(f"{start}.")


def _absolute(name: str) -> str:
    """Absolute path of a file. The name of a built-in (no suffix, no such file) is unchanged."""
    path = expand_user(name)
    return str(path.resolve()) if path.suffix or exists(path) else name


def check(
    scene: Path | None = None,
    as_json: bool = False,
) -> None:
    """Find probable mistakes in a scene: cameras that see nobody, people in walls … Exit code 1 if any."""
    from humansim_ros.scene.checks import check_scene
    from humansim_ros.scene.core import Scene

    loaded = Scene.load(scene)
    if loaded.config.adapter_settings:  # messages take long to load
        from humansim_ros.data.messages import check_adapters

        check_adapters(loaded)
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
    """Print the findings of a quick check as warnings, for commands that play a scene. ``options``: options
    that have replaced parts of the scene."""
    from humansim_ros.scene.checks import check_scene

    human = next(iter(scene.actors), "")
    for finding in check_scene(scene, quick=True):
        option = None if options is None else options.option(human, finding.key)
        print_warning(str(finding) if option is None else f"{option}: {finding.text}")


def _count(number: int, word: str) -> str:
    return f"{number} {word}{'' if number == 1 else 's'}"


def snapshot(
    output: Path,
    scene: Path | None = None,
    time: float = 0.0,
    channels: list[str] | None = None,
    width: int = 1600,
    no_joints: bool = False,
    no_plan: bool = False,
) -> None:
    """Draw on one sheet what every camera of a scene sees, with the joints, and the scene from above."""
    from humansim_ros.render.interface import ALL_CHANNELS
    from humansim_ros.render.pictures import write_png
    from humansim_ros.scene.core import Scene
    from humansim_ros.scene.pictures import snapshot as draw

    check_output(output, ".png")
    words = " ".join(channels or ["rgb"]).split()
    chosen = ALL_CHANNELS if words == ["all"] else tuple(words)
    image = draw(Scene.load(scene), time, chosen, width, not no_joints, not no_plan)
    write_png(output, image)
    print_text(f"wrote {output}: {image.shape[1]}x{image.shape[0]} pixels")


def schema(
    output: Path | None = None,
) -> None:
    """Print the JSON schema of scene files, for editors that complete and check YAML."""
    from humansim_ros.scene.config import schema_text

    text = schema_text()
    if output is None:
        print_text(text.rstrip())
        return
    check_output(output)
    write_file(output, text)
    print_text(f"wrote {output}")


def list_meshes(as_json: bool = False) -> None:
    """List the built-in meshes, which objects of a scene may use by name."""
    from humansim_ros.scene.core import BUILT_IN_MESHES, FURNITURE, SHAPES

    if as_json:
        meshes = {
            name: FURNITURE[name].mesh() if name in FURNITURE else SHAPES[name]() for name in BUILT_IN_MESHES
        }
        facts = [
            {
                "name": name,
                "description": BUILT_IN_MESHES[name],
                "low": mesh.vertices.min(0).round(6).tolist(),
                "high": mesh.vertices.max(0).round(6).tolist(),
            }
            for name, mesh in meshes.items()
        ]
        print_text(to_json(facts))
        return
    width = max(map(len, BUILT_IN_MESHES))
    for name, description in BUILT_IN_MESHES.items():
        print_text(f"{name:{width}}  {description}")
