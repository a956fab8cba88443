"""Load humans from human files, descriptions (YAML), meshes, skinned meshes and SMPL models.

Humans that take long to make are kept in a cache on disk. The key is the content that they are made from.
"""

from __future__ import annotations

import hashlib
import os
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, StringConstraints, model_validator

from humansim_ros.errors import HumansimError, HumansimWarning, MeshError, located, unknown, warn_about
from humansim_ros.files.mesh import (
    MAX_BYTES,
    MESH_SUFFIXES,
    Mesh,
    Simplification,
    SkinnedMesh,
    has_signature,
    material_files,
    read_format,
    read_mesh_or_figure,
    split_seams,
)
from humansim_ros.files.reading import MAX_BYTES as MAX_NPZ_BYTES
from humansim_ros.files.reading import (
    MAX_IMAGE_BYTES,
    archive_names,
    cache_folder,
    decode_image,
    encode_image,
    find_asset,
    missing_file,
    only_one_process,
    read_bytes,
    read_npz,
    read_table,
    resolve_relative,
    resource_path,
    resource_root,
)
from humansim_ros.files.yaml import Axis, ByteColor, Expected, Section, read_yaml, validated
from humansim_ros.motion.body import Skeleton, dominant_bones, hanim_skeleton
from humansim_ros.people.humans.human import (
    MAX_BONES,
    Human,
    Skinning,
    as_written,
    human_from_arrays,
    read_human,
    write_human,
)
from humansim_ros.people.makehuman.data import MakeHumanData, installed_data, people_data
from humansim_ros.people.makehuman.population import Person, is_person, person_config, read_person
from humansim_ros.people.makehuman.shape import MakeHumanConfig, Outfit

#: Names of arrays by which an archive is an SMPL model.
_SMPL_ARRAYS = {"v_template", "kintree_table", "weights"}
OutfitName = Annotated[
    str,
    StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_-]*$"),
    Expected("a name of letters, digits, _ and - that begins with a letter"),
]


class Clothes(Section):
    """Outfit of a mesh: a texture, or the colours of skin, hair, shirt, trousers and shoes."""

    texture: str | None = Field(default=None, description="a PNG or JPEG file, from the folder of this file")
    skin: ByteColor = (208, 158, 130)
    hair: ByteColor = (62, 44, 34)
    shirt: ByteColor = (88, 120, 158)
    trousers: ByteColor = (58, 62, 78)
    shoes: ByteColor = (44, 38, 36)


_Metres = Annotated[float, Field(ge=-10, le=10)]
#: Point in body space: x to the person's left, y up, z forward, metres.
BodyPoint = tuple[_Metres, _Metres, _Metres]

#: Outfits for a mesh without colours. With them, person detectors recognise it.
DEFAULT_OUTFITS = {name: Clothes(**row) for name, row in read_table("mesh_outfits").items()}


class MeshHuman(Section):
    """Human made from a mesh."""

    mesh: str = Field(default="", description="mesh file (.obj, .glb, .ply, .stl …), or an SMPL model (.npz)")
    betas: tuple[float, ...] = Field(default=(), max_length=400, description="shape of an SMPL model")
    rigging: Literal["heat", "thesis"] = Field(
        default="heat", description="rigging method of a mesh without skeleton"
    )
    skeleton: Literal["fitted", "general"] = Field(
        default="fitted", description="detected joints, or joints of the general skeleton"
    )
    joints: dict[str, BodyPoint] = Field(
        default_factory=dict,
        description="joints of the skeleton at other places than detected, in body space",
    )
    unit: float | None = Field(default=None, gt=0, le=1e6, description="metres per unit of the file")
    stature: float | None = Field(default=None, ge=0.2, le=5, description="height of the person, metres")
    up: Axis | None = Field(default=None, description="the file's up axis; detected if absent")
    facing: Axis | None = Field(
        default=None, description="the file's axis that the person faces; detected if absent"
    )
    skinning: Skinning | None = Field(default=None, description="linear, if absent, or dual_quaternion")
    outfits: dict[OutfitName, Clothes] = Field(default_factory=dict, description="the first is the default")

    @model_validator(mode="after")
    def _one_size(self) -> MeshHuman:
        if self.unit is not None and self.stature is not None:
            raise ValueError("give unit or stature, not both")
        return self


class ParametricHuman(Section):
    """Human made from MakeHuman sliders."""

    makehuman: MakeHumanConfig
    outfits: dict[OutfitName, Outfit] = Field(min_length=1, description="the first is the default")
    skinning: Skinning | None = Field(default=None, description="linear, if absent, or dual_quaternion")


def read_description(path: str | os.PathLike[str]) -> MeshHuman | ParametricHuman:
    """Read a human description. Raises MeshError with file, line and key."""
    data, tree = read_yaml(path, MeshError, "human")
    if not isinstance(data, dict) or ("mesh" in data) == ("makehuman" in data):
        raise MeshError("a human description needs exactly one of the keys 'mesh' and 'makehuman'", path=path)
    model: type[MeshHuman | ParametricHuman] = MeshHuman if "mesh" in data else ParametricHuman
    return validated(model, data, MeshError, path, tree)


#: Increase this number when the same input gives another human. test/humans/test_cache.py notices that.
CACHE_VERSION = 12
#: Level of compression in the cache. It takes a tenth of the time of the best level, for files of 1.2 times
#: the size.
_LEVEL = 1
#: Most files in the cache, about 1 MB each. The least recently used are deleted.
MAX_HUMANS = 100
#: Most files in the cache that were used within the second value (seconds). They stay although there are more
#: than :data:`MAX_HUMANS` files, since a running recipe needs the people of its pool again.
MAX_IN_USE, _LATELY = 1000, 86_400.0


def content_key(parts: Iterable[bytes]) -> str:
    """Digest of all content that a human is made from, of the joint data and of CACHE_VERSION."""
    digest = hashlib.sha256(str(CACHE_VERSION).encode())
    for part in (resource_path("config/body_joints.json").read_bytes(), *parts):
        digest.update(hashlib.sha256(part).digest())
    return digest.hexdigest()[:40]


def cached(key: str, name: str, make: Callable[[], Human]) -> Human:
    """Read a human from the cache, or make it and write it there.

    The human always has the rounded numbers of its file, even if nothing is cached, so that it is the same in
    all processes. A file that cannot be read (after a full disk or a crash) is replaced. Without write access
    nothing is cached, and a warning says so. If several processes start together, one makes the human, and
    the others wait.
    """
    folder = cache_folder()
    if folder is None:
        return as_written(replace(make(), name=name))
    path = folder / f"{name[:40]}-{key}.npz"
    human = _read(path)
    if human is None:
        with only_one_process(path.with_suffix(".lock")):
            human = _read(path) or _made_in(path, make)
    return replace(human, name=name)


def _read(path: Path) -> Human | None:
    """Human from a file in the cache; None if no file can be read."""
    if not path.is_file():
        return None
    try:
        human = read_human(path)
        os.utime(path)
    except (MeshError, OSError):
        with suppress(OSError):
            path.unlink(missing_ok=True)
        return None
    return human


def _made_in(path: Path, make: Callable[[], Human]) -> Human:
    """Make a human, and write it into the cache."""
    human = make()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_human(path, human, level=_LEVEL)
        _delete_oldest(path.parent)
    except (OSError, HumansimError) as reason:
        text = reason.strerror if isinstance(reason, OSError) else reason.message
        warnings.warn(
            f"{path.parent}: humans cannot be cached here ({text}), and each start makes them anew; set "
            "HUMANSIM_CACHE to another folder, or to off",
            HumansimWarning,
            stacklevel=3,
        )
    return as_written(human)


def _delete_oldest(folder: Path) -> None:
    """Delete the humans that were used least recently, except those that a running recipe may need."""
    used: dict[Path, float] = {}
    for file in folder.glob("*.npz"):
        with suppress(FileNotFoundError):  # another process has deleted it
            used[file] = file.stat().st_mtime
    lately = time.time() - _LATELY
    for number, file in enumerate(sorted(used, key=lambda file: -used[file])):
        if number >= (MAX_IN_USE if used[file] > lately else MAX_HUMANS):
            file.unlink(missing_ok=True)


_DESCRIPTIONS = (".yaml", ".yml")
#: Suffixes of files with a human.
SUFFIXES = (".npz", *_DESCRIPTIONS, *MESH_SUFFIXES)
#: Range of statures without a warning, metres.
_USUAL_STATURE = (1.0, 2.3)
_SKIN_BONES = ("vt3", "l_wrist", "r_wrist", "l_elbow", "r_elbow")
_SHOE_BONES = ("l_ankle", "r_ankle")
_TROUSER_BONES = (
    *("HumanoidRoot", "HumanoidRoot_to_l_hip", "HumanoidRoot_to_r_hip"),
    *("l_hip", "r_hip", "l_knee", "r_knee"),
)


def find_human(name: str, folder: Path | None = None, error: type[HumansimError] = MeshError) -> str:
    """Path of a built-in human or of a file.

    A drawn person (``person#7-3``) has no file: its name is returned.

    ``folder``: folder that relative paths start from. If None, the current folder. Raises ``error``.
    """
    return name if is_person(name) else str(find_asset(name, "humans", folder, error))


def load_human(
    path: str | os.PathLike[str], outfit: str | None = None, skinning: Skinning | None = None
) -> Human:
    """Load a built-in human, or a human from a file.

    A file is a human (.npz), a description (.yaml), a mesh (OBJ, glTF, VRM, FBX, PLY, STL, OFF, COLLADA, 3MF)
    or an SMPL model (.npz). Meshes without skeleton are rigged. Results of slow steps are cached on disk
    (docs/humans.md).

    Args:
        path: Name of a built-in human (``humansim human list``), name of a drawn person (``person#7-3``), or
            file to read.
        outfit: Name of the outfit to wear. If None, the default outfit.
        skinning: ``linear`` or ``dual_quaternion``. If None, the method that the file states.

    Raises:
        MeshError: The file is missing or wrong, or there is no such outfit.

    Example:
        >>> human = load_human("adult_man")
        >>> len(human.skeleton), human.weights.shape[1]
        (57, 57)
    """
    name = os.fspath(path)
    if not Path(path).suffix:
        path = find_human(name)
    with located(path=path):
        human = make_person(read_person(name), name) if is_person(name) else _load(Path(path))
        if outfit is not None:
            human = human.wearing(outfit)
    return human if skinning is None else replace(human, skinning=skinning)


def make_human(path: str | os.PathLike[str], options: MeshHuman | None = None) -> Human:
    """Make a human from a mesh, a skinned mesh or an SMPL model, without the cache. Raises MeshError."""
    options = options or MeshHuman()
    with located(path=path):
        human = _made(path, options)
    _warn_about_stature(path, human, options)
    return human


def _made(path: str | os.PathLike[str], options: MeshHuman) -> Human:
    # imported here, since human files need none of it, and the imports are slow
    from humansim_ros.people.loading.figure import read_smpl, to_body_space
    from humansim_ros.people.rigging.fitting import rig

    source: Mesh | SkinnedMesh
    if Path(path).suffix.lower() == ".npz":
        source = read_smpl(path, options.betas)
    else:
        source = read_mesh_or_figure(path)
    if isinstance(source, SkinnedMesh):
        if options.joints:
            message = "this mesh has its own joints, which cannot be moved: leave them out"
            raise MeshError(message, key="joints")
        mesh, skeleton, weights = to_body_space(source, options.unit, options.up, options.facing)
        if options.stature is not None:
            mesh, skeleton = _resized(mesh, skeleton, options.stature)
    else:
        mesh, skeleton = fit_mesh(source, options)
        weights = rig(mesh, skeleton, options.rigging)
    if len(skeleton) > MAX_BONES:
        raise MeshError(f"{len(skeleton)} bones; at most {MAX_BONES}", path=path)
    human = Human(Path(path).stem, mesh, skeleton, weights, skinning=options.skinning or "linear")
    looks = _looks(human, options.outfits, Path(path))
    return replace(human, looks=looks).wearing(next(iter(looks)))


def _warn_about_stature(path: str | os.PathLike[str], human: Human, options: MeshHuman) -> None:
    """Warn about a stature that no person has, unless the options state it."""
    stature = float(np.ptp(human.mesh.vertices[:, 1]))
    low, high = _USUAL_STATURE
    if options.stature is None and not low <= stature <= high:
        warn_about(
            path,
            f"the person is {stature:.3g} m tall. If that is wrong, give the height in metres with the key "
            "'stature' of a description, or with --stature of `humansim human rig` (docs/humans.md)",
        )


def _load(path: Path) -> Human:
    suffix = path.suffix.lower()
    if suffix == ".npz" and not set(_array_names(path)) >= _SMPL_ARRAYS:
        return read_human(path)
    if suffix in _DESCRIPTIONS:
        return _described(path)
    if suffix not in SUFFIXES and not has_signature(read_bytes(path, MeshError, "mesh", MAX_BYTES)):
        found = suffix or "a file without suffix"
        raise MeshError(f"a human is one of {', '.join(SUFFIXES)}, not {found}", path=path)
    return _from_mesh(path, path, MeshHuman())


def make_person(person: Person, name: str) -> Human:
    """Build a person whom :func:`~humansim_ros.people.makehuman.population.draw_person` has drawn. Raises
    MeshError if no slider setting gives the stature or weight."""
    data = people_data()

    def make() -> Human:
        from humansim_ros.people.makehuman.building import build

        config = person_config(data, person)
        return human_from_arrays(build(data, config, {"own": person.outfit}, fine=False), name)

    return cached(content_key([b"person", repr(person).encode(), data.version.encode()]), name, make)


def forget_people_data() -> None:
    """Free the data that people are made from, up to half a gigabyte. The next person takes as long as the
    first one."""
    people_data().kept.clear()
    people_data.cache_clear()


def _parametric(data: MakeHumanData, description: ParametricHuman, name: str) -> Human:
    """Make a human from MakeHuman sliders, or read it from the cache."""
    key = content_key([b"makehuman", repr(description).encode(), data.version.encode()])

    def make() -> Human:
        from humansim_ros.people.makehuman.building import build

        arrays = build(data, description.makehuman, description.outfits)
        human = human_from_arrays(arrays, name)
        return replace(human, skinning=description.skinning or "linear")

    return cached(key, name, make)


def _described(path: Path) -> Human:
    description = read_description(path)
    if isinstance(description, ParametricHuman):
        return _parametric(installed_data() or people_data(), description, path.stem)
    mesh, exists = resolve_relative(path, description.mesh)
    if mesh.suffix.lower() not in SUFFIXES or mesh.suffix.lower() in _DESCRIPTIONS:
        known = ", ".join(MESH_SUFFIXES)
        raise MeshError(f"a mesh is {known} or an SMPL model (.npz)", path=path, key="mesh")
    if not exists or not mesh.is_file():
        raise MeshError(missing_file(mesh), path=path, key="mesh")
    outfits = dict(description.outfits)
    for name, clothes in outfits.items():
        if clothes.texture is not None:
            texture = str(resolve_relative(path, clothes.texture)[0])
            outfits[name] = clothes.model_copy(update={"texture": texture})
    return _from_mesh(path, mesh, description.model_copy(update={"outfits": outfits}))


def _from_mesh(path: Path, mesh: Path, options: MeshHuman) -> Human:
    """Make a human from a mesh, or read it from the cache. ``path``: file that the human is named after."""
    key = content_key(_content(mesh, options))
    human = cached(key, path.stem, lambda: replace(_made(mesh, options), name=path.stem))
    _warn_about_stature(path, human, options)
    return human


def _array_names(path: Path) -> list[str]:
    """Names of the arrays of an archive. Empty if the file is no archive."""
    names = archive_names(read_bytes(path, MeshError, "human", MAX_NPZ_BYTES))
    return [name.removesuffix(".npy") for name in names]


def _content(path: Path, options: MeshHuman) -> Iterable[bytes]:
    """All content that a human is made from."""
    yield options.model_dump_json().encode()
    kind, data = read_format(path)
    yield data
    if path.suffix.lower() == ".npz":
        return
    if kind == "gltf":
        from humansim_ros.files.mesh import Gltf

        yield from Gltf.parse(path, data).external_data()
    elif kind == "obj":
        for file in material_files(path):
            yield read_bytes(file, MeshError, "material", MAX_IMAGE_BYTES)
    for clothes in options.outfits.values():
        if clothes.texture is not None:
            yield read_bytes(clothes.texture, MeshError, "texture", MAX_IMAGE_BYTES)


def fit_mesh(mesh: Mesh, options: MeshHuman) -> tuple[Mesh, Skeleton]:
    """Fit a skeleton to a mesh of a person, with the joints that the options place. Raises MeshError."""
    # imported here, since the import is slow
    from humansim_ros.people.rigging.fitting import fit_skeleton, joints_of, skeleton_at

    given = {name: getattr(options, name) for name in ("up", "facing", "unit", "stature")}
    fitted, skeleton = fit_skeleton(mesh, options.skeleton, **given)
    if options.joints:
        joints = joints_of(skeleton)
        for name, place in options.joints.items():
            if name not in joints:
                raise MeshError(unknown("joint", name, joints), key=f"joints.{name[:60]}")
            joints[name] = np.array(place)
        skeleton = skeleton_at(joints)
    return fitted, skeleton


def _resized(mesh: Mesh, skeleton: Skeleton, stature: float) -> tuple[Mesh, Skeleton]:
    factor = stature / float(np.ptp(mesh.vertices[:, 1]))
    larger = replace(skeleton, heads=factor * skeleton.heads, tails=factor * skeleton.tails)
    return replace(mesh, vertices=factor * mesh.vertices), larger


def _looks(human: Human, outfits: Mapping[str, Clothes], path: Path) -> dict[str, NDArray[np.uint8]]:
    """Outfits of a mesh: from the options; or else its own texture or colours; or else colours by body
    part."""
    mesh = human.mesh
    if not outfits and mesh.texture is not None:
        return {"default": encode_image(mesh.texture)}
    if not outfits and mesh.colors is not None:
        return {"default": mesh.colors}
    looks = {}
    for name, clothes in (outfits or DEFAULT_OUTFITS).items():
        if clothes.texture is None:
            looks[name] = _part_colors(human, clothes)
            continue
        key = f"outfits.{name}.texture"
        if mesh.uv is None:
            raise MeshError("the mesh has no texture coordinates: use colours", path=path, key=key)
        data = read_bytes(clothes.texture, MeshError, "texture", MAX_IMAGE_BYTES)
        decode_image(data)  # raises the error of a wrong image now
        looks[name] = np.frombuffer(data, np.uint8)
    return looks


def _part_colors(human: Human, clothes: Clothes) -> NDArray[np.uint8]:
    """Vertex colours (V, 3) by the dominant bone, or by its nearest ancestor in the general skeleton."""
    skeleton, general = human.skeleton, set(hanim_skeleton().names)
    palette = np.empty((len(skeleton), 3), np.uint8)
    for bone, parent in enumerate(skeleton.parents):
        name = skeleton.names[bone]
        if name in _SKIN_BONES:
            palette[bone] = clothes.skin
        elif name in _SHOE_BONES:
            palette[bone] = clothes.shoes
        elif name in _TROUSER_BONES:
            palette[bone] = clothes.trousers
        elif name in general or parent < 0:
            palette[bone] = clothes.shirt
        else:
            palette[bone] = palette[parent]
    colors = palette[dominant_bones(human.weights)]
    # the head is about an eighth of the height, with hair on its top and back
    vertices = human.mesh.vertices
    height = float(np.ptp(vertices[:, 1]))
    up = 1 + (vertices[:, 1] - vertices[:, 1].max()) / (0.13 * height)  # 0 at the chin, 1 on top
    middle = vertices[up > 0.5, 2]
    ahead = (vertices[:, 2] - (middle.min() + middle.max()) / 2) / (0.13 * height)
    hair = (up > 0.40) & (up - 0.75 * ahead > 0.54)
    colors[hair & (colors == np.array(clothes.skin, np.uint8)).all(1)] = clothes.hair
    return colors


#: Increase this number when the same human gets other levels, and run tools/assets/simplify_humans.py.
LEVELS_VERSION = 1
#: Folder of the levels of the humans of the package.
LEVELS_FOLDER = "assets/humans/levels"
#: Arrays of a file of levels, each with its type in memory and its type in the file.
LEVELS_ARRAYS: dict[str, tuple[type, type]] = {
    "parents": (np.intp, np.int32),
    "coordinate_parents": (np.intp, np.int32),
    "removed_at": (np.uint8, np.uint8),
    "errors": (float, float),
}


def levels_of(human: Human) -> Simplification | None:
    """Read the levels of detail of a human of the package. None for other humans."""
    path = levels_path(human, resource_root() / LEVELS_FOLDER)
    return read_levels(path) if path.is_file() else None


def levels_path(human: Human, folder: Path) -> Path:
    """File of the levels of a human in a folder. Its name is a digest of all that the levels depend on."""
    mesh, weights = human.mesh, human.weights
    digest = hashlib.sha256(f"{LEVELS_VERSION} {human.skinning}".encode())
    for values in (mesh.vertices, weights.data, human.skeleton.rest_inverse):
        digest.update(np.ascontiguousarray(values, dtype="<f4").tobytes())
    for values in (mesh.triangles, split_seams(mesh)[2], weights.indices, weights.indptr):
        digest.update(np.ascontiguousarray(values, dtype="<i4").tobytes())
    return folder / f"{digest.hexdigest()[:40]}.npz"


def read_levels(path: Path) -> Simplification:
    """Read levels. Raises MeshError for a file that has no levels."""
    arrays = read_npz(path, MeshError, "file of levels of detail")
    try:
        return Simplification(
            **{name: arrays[name].astype(kind) for name, (kind, _) in LEVELS_ARRAYS.items()}
        )
    except KeyError as missing:
        raise MeshError("an array is missing", path=path, key=str(missing.args[0])) from None
