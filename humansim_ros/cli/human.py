"""The ``humansim human`` commands: which people there are, how they look, and how a mesh becomes one."""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from humansim_ros.cli.output import check_folder, say, to_json, written
from humansim_ros.errors import HumansimError, MeshError

if TYPE_CHECKING:
    from humansim_ros.humans.human import Human

app = typer.Typer(help="Look at people, make them, rig meshes.", no_args_is_help=True)


class Rule(Enum):
    heat = "heat"
    thesis = "thesis"


class Joints(Enum):
    fitted = "fitted"
    general = "general"


class Way(Enum):
    linear = "linear"
    dual_quaternion = "dual_quaternion"


Who = Annotated[
    str,
    typer.Argument(help="A built-in human (see `humansim human list`), or a file: .npz, .yaml, .obj, .glb …"),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for programs.")]
Preview = Annotated[Path | None, typer.Option(help="A picture of it as well (.png).")]


@app.command("list")
def list_humans(as_json: Json = False) -> None:
    """The people that come with the package."""
    people = [describe_human(_load(name)) for name in built_in_humans()]
    if as_json:
        say(to_json(people))
        return
    width = max(len(person["name"]) for person in people)
    for person in people:
        size = f"{person['stature']:.2f} m, {person['vertices']} vertices"
        say(f"{person['name']:{width}}  {size}; wears {', '.join(person['outfits'])}")


@app.command()
def show(
    who: Who,
    output: Annotated[Path, typer.Option("--output", "-o", help="The picture (.png).")],
    outfit: Annotated[str | None, typer.Option(help="What it wears.")] = None,
) -> None:
    """A sheet with the human from all sides, its bones, its weights and its outfits."""
    _check_picture(output)
    human = _load(who, outfit)
    _draw(human, output)


@app.command()
def info(who: Who, as_json: Json = False) -> None:
    """What is in a file with a human: size, bones, weights, outfits, what is odd."""
    facts = describe_human(_load(who))
    say(to_json(facts) if as_json else "\n".join(_info_lines(facts)))


@app.command()
def build(
    config: Annotated[
        Path, typer.Argument(help="A description (.yaml), see config/humans and docs/humans.md.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="The human (.npz).")],
    preview: Preview = None,
) -> None:
    """Make a human of a description: of MakeHuman's sliders, or of a mesh."""
    if config.suffix.lower() not in (".yaml", ".yml"):
        raise MeshError("a description is a .yaml file; `humansim human rig` takes meshes", path=config)
    _check_human(output)
    _check_picture(preview)
    _write(_load(str(config)), output, preview)


@app.command()
def rig(
    mesh: Annotated[
        Path, typer.Argument(help="A mesh in T or A pose (.obj, .gltf, .glb), or an SMPL model.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="The human (.npz).")],
    preview: Preview = None,
    rigging: Annotated[Rule, typer.Option(help="How an unrigged mesh gets its weights.")] = Rule.heat,
    skeleton: Annotated[
        Joints, typer.Option(help="Joints found in the mesh, or those of the general skeleton.")
    ] = Joints.fitted,
    skinning: Annotated[Way, typer.Option(help="How skin follows bones.")] = Way.linear,
    unit: Annotated[float | None, typer.Option(help="Metres per unit of the file.")] = None,
    stature: Annotated[float | None, typer.Option(help="Height of the person, metres.")] = None,
    up: Annotated[str | None, typer.Option(help="The file's up axis, such as y or -z.")] = None,
    facing: Annotated[str | None, typer.Option(help="The file's axis that the person faces.")] = None,
) -> None:
    """Fit a skeleton into a mesh, and tie its skin to the bones; a rigged figure keeps its own weights."""
    from pydantic import ValidationError

    from humansim_ros.humans.description import MeshHuman
    from humansim_ros.humans.loading import make_human

    _check_human(output)
    _check_picture(preview)
    options = {"rigging": rigging.value, "skeleton": skeleton.value, "skinning": skinning.value}
    given = {"unit": unit, "stature": stature, "up": up, "facing": facing}
    try:
        described = MeshHuman.model_validate({"mesh": str(mesh), **options, **given})
    except ValidationError as reason:
        first = reason.errors()[0]
        where = f"--{first['loc'][0]}: " if first["loc"] else ""
        raise HumansimError(f"{where}{first['msg'].removeprefix('Value error, ')}") from None
    _write(make_human(mesh, described), output, preview)


def built_in_humans() -> list[str]:
    """Names of the humans in assets/humans."""
    from humansim_ros.io.assets import built_in_names

    return built_in_names("humans")


def describe_human(human: Human) -> dict[str, Any]:
    """What there is to say of a human, as JSON can hold it."""
    import numpy as np

    mesh, counts = human.mesh, np.diff(human.weights.indptr)
    quads = int((mesh.faces[:, 3] >= 0).sum())
    return {
        "name": human.name,
        "stature": float(np.ptp(mesh.vertices[:, 1])),
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "quads": quads,
        "triangles": len(mesh.triangles),
        "closed": mesh.closed,
        "bones": len(human.skeleton),
        "bone_names": list(human.skeleton.names),
        "bones_per_vertex": {"mean": float(counts.mean()), "most": int(counts.max())},
        "outfits": list(human.outfits),
        "texture": None if mesh.texture is None else [mesh.texture.shape[1], mesh.texture.shape[0]],
        "skinning": human.skinning,
        **{key: human.notes.get(key) for key in ("license", "source")},
    }


def _info_lines(facts: dict[str, Any]) -> Iterator[str]:
    yield facts["name"]
    surface = "closed" if facts["closed"] else "open, or facing both ways in places"
    yield f"  {facts['stature']:.3f} m tall; {facts['vertices']} vertices, {facts['faces']} faces, {surface}"
    most, mean = facts["bones_per_vertex"]["most"], facts["bones_per_vertex"]["mean"]
    yield f"  {facts['bones']} bones; a vertex follows up to {most} of them, {mean:.1f} in the mean"
    yield f"  {facts['skinning'].replace('_', ' ')} skinning"
    look = (
        "colours of the vertices" if facts["texture"] is None else "texture {} x {}".format(*facts["texture"])
    )
    yield f"  {look}; wears {', '.join(facts['outfits'])}"
    for key in ("source", "license"):
        if facts[key]:
            yield f"  {key}: {facts[key]}"


def _load(who: str, outfit: str | None = None) -> Human:
    from humansim_ros.humans.loading import load_human
    from humansim_ros.io.assets import find_asset

    return load_human(find_asset(who, "humans"), outfit)


def _write(human: Human, output: Path, preview: Path | None) -> None:
    from humansim_ros.humans.human import write_human

    with written(output):
        write_human(output, human)
    say(f"wrote {output}")
    if preview is not None:
        _draw(human, preview)


def _draw(human: Human, output: Path) -> None:
    from humansim_ros.drawing.canvas import write_png
    from humansim_ros.drawing.humans import human_sheet

    with written(output):
        write_png(output, human_sheet(human))
    say(f"wrote {output}")


def _check_human(output: Path) -> None:
    if output.suffix.lower() != ".npz":
        raise HumansimError("a human is written as .npz: give the file that name", path=output)
    check_folder(output)


def _check_picture(output: Path | None) -> None:
    if output is None:
        return
    if output.suffix.lower() != ".png":
        raise HumansimError("the picture is a .png: give the file that name", path=output)
    check_folder(output)
