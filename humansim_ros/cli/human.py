"""The ``humansim human`` commands: list, draw, build, rig humans, and fit them to photographs."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from humansim_ros.cli.output import check_output, print_text, to_json
from humansim_ros.errors import HumansimError, MeshError
from humansim_ros.files.reading import resource_path

if TYPE_CHECKING:
    from humansim_ros.people.humans import Human
    from humansim_ros.photographs import PersonFit, PhotoSet

#: File of facts about the built-in humans, which tools/assets/list_humans.py writes.
BUILT_IN_FACTS = "assets/humans/humans.json"


def list_humans(as_json: bool = False) -> None:
    """List the built-in humans."""
    # facts that are known beforehand, since loading the humans takes seconds
    humans = json.loads(resource_path(BUILT_IN_FACTS).read_text("utf-8"))
    if as_json:
        print_text(to_json(humans))
        return
    width = max(len(human["name"]) for human in humans)
    for human in humans:
        size = f"{human['stature']:.2f} m, {human['vertices']} vertices"
        print_text(f"{human['name']:{width}}  {size}; wears {', '.join(human['outfits'])}")


def joints(as_json: bool = False) -> None:
    """List the joints of humans with their places, and their names in H-Anim 2, SMPL, COCO and OpenPose."""
    from dataclasses import asdict

    from humansim_ros.motion.body import JOINT_NAMES, SETS

    if as_json:
        print_text(to_json([asdict(row) for row in JOINT_NAMES]))
        return
    titles = ("joint", "place", *SETS.values())
    table = [titles, *((row.name, row.place, *map(row.in_set, SETS)) for row in JOINT_NAMES)]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for line in table:
        cells = (f"{cell:{width}}" for cell, width in zip(line, widths, strict=True))
        print_text("  ".join(cells).rstrip())
    print_text(
        "~: the nearest joint of that set, at another place. <name>_end is the end of the bone <name>."
    )


def show(
    human: str,
    output: Path,
    outfit: str | None = None,
) -> None:
    """Draw a human from all sides, with its bones, weights and outfits."""
    check_output(output, ".png")
    _draw(load_named(human, outfit), output)


def info(human: str, as_json: bool = False) -> None:
    """Describe a human: size, bones, weights, outfits, licence."""
    facts = describe_human(load_named(human))
    print_text(to_json(facts) if as_json else "\n".join(_info_lines(facts)))


def build(
    config: Path,
    output: Path,
    picture: Path | None = None,
) -> None:
    """Build a human from a description: MakeHuman parameters or a mesh."""
    if config.suffix.lower() not in (".yaml", ".yml"):
        raise MeshError("a description is a .yaml file; use `humansim human rig` for meshes", path=config)
    check_output(output, ".npz")
    check_output(picture, ".png")
    _write(load_named(str(config)), output, picture)


@dataclass(frozen=True)
class ClothesOptions:
    """Options of ``make`` about hair and clothes. Each attribute has the name of its option."""

    hair: str | None = None
    beard: str | None = None
    top: str | None = None
    bottom: str | None = None
    shoes: str | None = None
    wears: list[str] | None = None

    @property
    def given(self) -> dict[str, Any]:
        """What is given, by name."""
        given: dict[str, Any] = {key: value for key, value in vars(self).items() if value}
        if self.wears:
            given["wears"] = () if self.wears == ["nothing"] else tuple(self.wears)
        return given


def make(
    output: Path,
    age: float | None = None,
    sex: Literal["female", "male"] | None = None,
    height: float | None = None,
    weight: float | None = None,
    skin: int | None = None,
    *,
    clothes: ClothesOptions,
    seed: int = 0,
    picture: Path | None = None,
) -> None:
    """Make a person: by seed, from surveys of people, and by what is given."""
    from humansim_ros.people.loading import make_person
    from humansim_ros.people.makehuman import AGES, draw_person

    check_output(output, ".npz")
    check_output(picture, ".png")
    try:
        person = draw_person(
            seed,
            ages=AGES if age is None else (age, age),
            sex=sex,
            stature=height,
            weight=weight,
            tone=skin,
            clothes=clothes.given,
        )
        human = make_person(person, output.stem)
    except MeshError as reason:
        raise MeshError(f"--{reason.key}: {reason.message}" if reason.key else reason.message) from None
    print_text(
        f"{person.sex}, {person.age:g} years, {person.stature:.2f} m, {person.weight:.1f} kg "
        f"(body mass index {person.bmi:.1f}), skin {person.tone} of 10"
    )
    worn = person.clothes
    things = ", ".join((worn.top, worn.bottom, worn.shoes, *worn.wears))
    print_text(f"hair: {worn.hair}, beard: {worn.beard}, wears {things}")
    _write(human, output, picture)


def rig(
    mesh: Path,
    output: Path,
    picture: Path | None = None,
    rigging: Literal["heat", "thesis"] = "heat",
    skeleton: Literal["fitted", "general"] = "fitted",
    skinning: Literal["linear", "dual_quaternion"] = "linear",
    unit: float | None = None,
    stature: float | None = None,
    up: str | None = None,
    facing: str | None = None,
) -> None:
    """Fit a skeleton to a mesh and compute weights. A mesh that has weights keeps them."""
    from pydantic import ValidationError

    from humansim_ros.files.yaml import schema_errors
    from humansim_ros.people.loading import MeshHuman, make_human

    check_output(output, ".npz")
    check_output(picture, ".png")
    options = {"rigging": rigging, "skeleton": skeleton, "skinning": skinning}
    given = {"unit": unit, "stature": stature, "up": up, "facing": facing}
    try:
        described = MeshHuman.model_validate({"mesh": str(mesh), **options, **given})
    except ValidationError as reason:
        fault = schema_errors(reason, MeshHuman, HumansimError)[0]
        raise HumansimError(f"--{fault.key}: {fault.message}" if fault.key else fault.message) from None
    _write(make_human(mesh, described), output, picture)


def built_in_humans() -> list[str]:
    """Names of the built-in humans: the files in assets/humans."""
    from humansim_ros.files.reading import built_in_names

    return built_in_names("humans")


def describe_human(human: Human) -> dict[str, Any]:
    """Collect facts about a human for ``humansim human info --json``."""
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
    surface = "closed" if facts["closed"] else "open, or with inconsistent normals"
    yield f"  {facts['stature']:.3f} m tall; {facts['vertices']} vertices, {facts['faces']} faces, {surface}"
    most, mean = facts["bones_per_vertex"]["most"], facts["bones_per_vertex"]["mean"]
    yield f"  {facts['bones']} bones; up to {most} per vertex, {mean:.1f} on average"
    yield f"  {facts['skinning'].replace('_', ' ')} skinning"
    appearance = "vertex colours" if facts["texture"] is None else "texture {} x {}".format(*facts["texture"])
    yield f"  {appearance}; wears {', '.join(facts['outfits'])}"
    for key in ("source", "license"):
        if facts[key]:
            yield f"  {key}: {facts[key]}"


def load_named(name: str, outfit: str | None = None) -> Human:
    """Load a built-in human or a file. ``outfit``: name of the outfit to wear. If None, the first outfit."""
    from humansim_ros.people.loading import find_human, load_human

    return load_human(find_human(name), outfit)


def _write(human: Human, output: Path, picture: Path | None) -> None:
    from humansim_ros.people.humans import write_human

    write_human(output, human)
    print_text(f"wrote {output}")
    if picture is not None:
        _draw(human, picture)


def _draw(human: Human, output: Path) -> None:
    from humansim_ros.render.pictures import write_png
    from humansim_ros.scene.pictures import human_sheet

    write_png(output, human_sheet(human))
    print_text(f"wrote {output}")


# -- humans from photographs


def fit(
    views: Path,
    output: Path,
    body: str | None = None,
    detector: str | None = None,
    silhouettes: bool = True,
    picture: Path | None = None,
    bvh: Path | None = None,
    npz: Path | None = None,
) -> None:
    """Fit a human to calibrated photographs: pose, place, stature, proportions."""
    # set before NumPy is loaded: its threads cost more than they save for matrices of some hundred rows
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from humansim_ros.motion.files import write_bvh
    from humansim_ros.people.humans import write_human
    from humansim_ros.photographs import detect_points, fit_motion, fit_person, read_views, write_fit

    check_output(output, ".yaml")
    check_output(picture, ".png")
    check_output(bvh, ".bvh")
    check_output(npz, ".npz")
    photos = read_views(views)
    if detector is not None:
        photos = detect_points(photos, detector, _print_progress)
    found = fit_person(photos, body, silhouettes=silhouettes, progress=_print_step)
    write_fit(output, found)
    print_text("\n".join(_lines(found, photos)))
    print_text(f"wrote {output}")
    if picture is not None:
        from humansim_ros.photographs import draw_report
        from humansim_ros.render.pictures import write_png

        # for a sequence, another fit would take long
        masks = any(photo.mask_path is not None for photo in photos.frames[0])
        compared = silhouettes and masks and len(photos.frames) == 1
        before = fit_person(photos, body, silhouettes=False) if compared else None
        write_png(picture, draw_report(found, photos, before))
        print_text(f"wrote {picture}")
    if bvh is not None:
        write_bvh(bvh, fit_motion(found))
        print_text(
            f"wrote {bvh}; in a scene, motion: {{file: {bvh.name}, anchor: file}} plays it in its place"
        )
    if npz is not None:
        write_human(npz, found.body)
        print_text(f"wrote {npz}")


def texture(
    views: Path,
    fit_file: Path,
    output: Path,
    method: Literal["atlas", "thesis"] = "atlas",
    texture_size: int = 2048,
    frame: list[str] | None = None,
    picture: Path | None = None,
) -> None:
    """Texture a fitted human from the photographs."""
    from humansim_ros.people.humans import write_human
    from humansim_ros.photographs import read_fit, read_views, texture_person

    check_output(output, ".npz")
    check_output(picture, ".png")
    numbers = tuple(_whole_number(word) for word in frame or ("0",))
    photos, fitted = read_views(views), read_fit(fit_file)
    textured = texture_person(fitted, photos, method, frames=numbers, size=texture_size)
    write_human(output, textured.human)
    seen = float(textured.seen.mean())
    print_text(f"{textured.human.name}: {seen:.0%} of the faces are seen by a camera")
    print_text(f"wrote {output}")
    if picture is not None:
        from humansim_ros.photographs import draw_sheet
        from humansim_ros.render.pictures import write_png
        from humansim_ros.scene.pictures import HumanArtist

        with closing(HumanArtist(textured.human, shaded=False)) as artist:
            write_png(picture, draw_sheet(textured, artist.draw))
        print_text(f"wrote {picture}")


def _lines(fit: PersonFit, photos: PhotoSet) -> list[str]:
    """Lines of text with facts about a fit."""
    import numpy as np

    used = fit.residuals[~fit.outliers & np.isfinite(fit.residuals)]
    stature, count = float(np.ptp(fit.body.mesh.vertices[:, 1])), len(fit.root)
    lines = [
        f"{count} frame{'s' if count > 1 else ''}, {len(fit.views)} views; {stature:.2f} m tall",
        f"points: {np.median(used):.1f} px from the photographs (median), 95% within "
        f"{np.percentile(used, 95):.1f} px; {int(fit.outliers.sum())} left out"
        if len(used)
        else "no points",
    ]
    if any(photo.mask_path is not None for photo in photos.frames[0]):
        from humansim_ros.photographs import silhouette_iou

        overlap = silhouette_iou(fit, photos, 0)
        lines.append("silhouettes: " + ", ".join(f"{name} {value:.3f}" for name, value in overlap.items()))
    return lines


def _print_step(step: str, done: int, count: int) -> None:
    """Show the progress of a fit of several frames. For a single frame, which is quick, show nothing."""
    if count > 1 and (done == count or done % 25 == 0):
        print_text(f"{step}: {done} of {count} frames")


def _print_progress(done: int, count: int) -> None:
    if done == count or done % 10 == 0:
        print_text(f"detector: {done} of {count} images")


def _whole_number(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) < 10):
        raise HumansimError(f"--frame: needs numbers of frames, from 0, not {text!r}")
    return int(text)
