"""Read motion files of any supported format."""

from __future__ import annotations

import os
import warnings
import zipfile
from dataclasses import replace
from pathlib import Path, PurePosixPath

from humansim_ros.errors import HumansimError, MotionError, some_of, unknown, warn_about
from humansim_ros.files.reading import (
    ARCHIVE_ERRORS,
    built_in_names,
    exists,
    find_asset,
    open_file,
    resource_path,
    size_text,
    temporary_folder,
)
from humansim_ros.motion.body.kinematics import Motion
from humansim_ros.motion.files.activity import is_activity, read_activity
from humansim_ros.motion.files.bvh import PositionChannels, read_bvh
from humansim_ros.motion.files.motion_formats import (
    MOTION_TITLES,
    motion_format,
    split_motion_name,
    unread_format,
)
from humansim_ros.motion.matching.by_shape import is_person

#: Largest archive and largest file in an archive (bytes), and most files of an archive.
_MAX_ARCHIVE, _MAX_MEMBER, _MAX_MEMBERS = 1 << 30, 1 << 28, 10_000
#: Formats that are read from archives: the formats that are text.
_IN_ARCHIVES = ("bvh", "acclaim")


def find_motion(name: str, folder: Path | None = None, error: type[HumansimError] = MotionError) -> str:
    """Return the path of a built-in motion or a file, with any text after ``#`` (``figure.glb#Walk``).

    An activity (``activity#4``) has no file: its name is returned.

    ``folder``: folder that relative paths start from. If None, the current folder. Raises ``error`` if
    nothing is found.
    """
    if is_activity(name):
        return name
    file, part = split_motion_name(name)
    path = find_asset(file, "motions", folder, error)
    return str(path) if part is None else f"{path}#{part}"


def read_motion(path: str | os.PathLike[str], positions: PositionChannels = "auto") -> Motion:
    """Read a motion: a built-in motion (``walk``), or a file of one of the formats in docs/motion.md.

    ``path``: name or file. A name after ``#`` chooses a part of the file. In a BVH file, this is the root of
    a person (``two.bvh#B_Hips``). In a glTF file, it is the animation (``figure.glb#Walk``). Without a name,
    the first person or animation is taken. For an AMC file, it is the skeleton file (``07_01.amc#07.asf``).
    In an archive, it is the file (``all.zip#walk.bvh``, or ``all.zip/walk.bvh``). For an activity, it is the
    seed (``activity#4``). ``positions``: meaning of the position channels of BVH; see
    :func:`~humansim_ros.motion.files.bvh.read_bvh`.

    Raises:
        MotionError: The file is not valid, or has no such part.

    Example:
        >>> from humansim_ros import read_motion
        >>> round(read_motion("run").duration, 2)
        1.4
    """
    if is_activity(os.fspath(path)):
        return read_activity(os.fspath(path))
    file, part = split_motion_name(path)
    if not Path(file).suffix:
        file = str(find_asset(file, "motions", error=MotionError))
    known = motion_format(file)
    name = "bvh" if known is None else known.name
    if name == "zip":
        return _read_archive(Path(file), part, positions)
    # imported here, since most motions are BVH files
    if name in ("gltf", "vrma", "fbx", "collada"):
        from humansim_ros.motion.files.gltf_motion import read_gltf_motion

        return read_gltf_motion(file, part)
    if name == "acclaim":
        from humansim_ros.motion.files.acclaim import read_acclaim

        return read_acclaim(file, part)
    if name in ("smpl", "poses"):
        from humansim_ros.motion.files.smpl_motion import read_smpl_motion

        return read_smpl_motion(file, part)
    if name == "markers":
        from humansim_ros.motion.files.marker_motion import read_marker_motion

        return read_marker_motion(file, part)
    try:
        motion = _one_person(read_bvh(file, positions), part)
    except MotionError:
        other = unread_format(file)
        if other is None or not exists(Path(file)):
            raise
        raise MotionError(f"this is {other}", path=file) from None
    # people of built-in motions may lie or crawl all the time, so the up axis is given
    return replace(motion, up="y") if _is_built_in(Path(file)) else motion


def _one_person(motion: Motion, root: str | None) -> Motion:
    """Keep the joints below a root of a motion. If ``root`` is None, keep the first of several people."""
    trees: dict[str, list[int]] = {}
    tree_of: list[list[int]] = []
    for joint, parent in enumerate(motion.parents.tolist()):
        tree_of.append(tree_of[parent] if parent >= 0 else trees.setdefault(motion.joint_names[joint], []))
        tree_of[joint].append(joint)
    if root is not None:
        if root not in trees:
            raise MotionError(unknown("root", root, trees, "the file"), path=motion.path)
        return motion.only(trees[root])
    people = [name for name in trees if len(trees) > 1 and is_person(motion.only(trees[name]))]
    if len(people) < 2:
        return motion
    found = f"{len(people)} people, with the roots {some_of(people)}"
    other = f"{Path(motion.path).name}#{people[1]}"
    warn_about(motion.path, f"{found}: the first is read; the others are read by name, such as {other}")
    return motion.only(trees[people[0]])


def _is_built_in(path: Path) -> bool:
    return path.stem in built_in_names("motions") and path.resolve().parent == resource_path("assets/motions")


def _read_archive(path: Path, member: str | None, positions: PositionChannels) -> Motion:
    """Read the motion of a file in a ZIP archive. The file is unpacked into a folder of its own. ``member``:
    name of the file. If None, the only motion of the archive."""
    with temporary_folder() as folder:
        with open_file(path, MotionError, "ZIP archive", _MAX_ARCHIVE) as stream:
            try:
                with zipfile.ZipFile(stream) as archive:
                    chosen = _choose(path, archive, member)
                    shown = f"{path}/{chosen.filename}"
                    for entry in (*_skeletons(archive, chosen), chosen):
                        if entry.file_size > _MAX_MEMBER:
                            too_large = f"unpacks to more than {size_text(_MAX_MEMBER)}"
                            raise MotionError(f"{entry.filename!r} {too_large}", path=path)
                        # without its folders, no name leads elsewhere; no more than the stated size is read
                        entry.filename = PurePosixPath(entry.filename).name
                        unpacked = Path(archive.extract(entry, folder))
            except ARCHIVE_ERRORS as reason:
                raise MotionError(f"not a ZIP archive that can be read: {reason}", path=path) from None
        try:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                motion = read_motion(unpacked, positions)
        except HumansimError as error:
            message = error.message.replace(f"{folder}/", "")
            raise MotionError(message, path=shown, line=error.line, key=error.key) from None
    for warning in caught:
        text = str(warning.message).replace(str(unpacked), shown).replace(f"{folder}/", "")
        warnings.warn(text, warning.category, stacklevel=3)
    return replace(motion, path=shown)


def _choose(path: Path, archive: zipfile.ZipFile, member: str | None) -> zipfile.ZipInfo:
    entries = [entry for entry in archive.infolist() if not entry.is_dir()]
    if len(entries) > _MAX_MEMBERS:
        raise MotionError(f"{len(entries)} files are too many for an archive of motions", path=path)
    motions = [entry for entry in entries if _is_motion(entry.filename)]
    names = [entry.filename for entry in motions]
    if not motions:
        there = f"it has {some_of(repr(entry.filename) for entry in entries)}" if entries else "it is empty"
        raise MotionError(f"no motion in the archive ({MOTION_TITLES}); {there}", path=path)
    if member is None:
        if len(motions) > 1:
            text = f"the archive has {len(motions)} motions: name one, such as {path.name}/{names[0]}"
            raise MotionError(f"{text}; they are {some_of(names)}", path=path)
        return motions[0]
    if member not in names:
        raise MotionError(unknown("motion", member, names, "the archive"), path=path)
    return motions[names.index(member)]


def _is_motion(name: str) -> bool:
    known, path = motion_format(name), PurePosixPath(name)
    hidden = "__MACOSX" in path.parts or path.name.startswith(".")
    return known is not None and known.name in _IN_ARCHIVES and path.suffix.lower() != ".asf" and not hidden


def _skeletons(archive: zipfile.ZipFile, motion: zipfile.ZipInfo) -> list[zipfile.ZipInfo]:
    """Skeleton files in the folder of an AMC file."""
    own = PurePosixPath(motion.filename)
    if own.suffix.lower() != ".amc":
        return []
    entries = [(entry, PurePosixPath(entry.filename)) for entry in archive.infolist()]
    return [e for e, name in entries if name.suffix.lower() == ".asf" and name.parent == own.parent][:100]
