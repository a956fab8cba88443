"""Files that browsers upload: checked, and saved in the folder of the scene under a safe name.

Uploaded files are not trusted. The file name keeps only plain characters, and a file is saved only if the
reader of its kind can read it. The server limits the size
(:class:`humansim_ros.view.server.server.UploadGate`).
"""

from __future__ import annotations

import os
import re
import tempfile
import unicodedata
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from humansim_ros.cameras.formats import load_calibration
from humansim_ros.data.evaluation import ESTIMATE_SUFFIXES
from humansim_ros.errors import HumansimError, printable
from humansim_ros.files.mesh import MESH_SUFFIXES, read_mesh, read_mesh_or_figure
from humansim_ros.files.reading import decode_image, exists, read_bytes, size_text
from humansim_ros.files.yaml import read_yaml
from humansim_ros.motion.files import MOTION_SUFFIXES, read_keyframes, read_motion
from humansim_ros.motion.matching import load_table, match_motion
from humansim_ros.people.loading import SUFFIXES as HUMAN_SUFFIXES
from humansim_ros.people.loading import load_human
from humansim_ros.view.server.server import MOST_UPLOAD, check_value, inside

#: Longest file name without suffix, and most files of a folder that the page lists.
_LONGEST, _MOST_FILES = 80, 500
_TEXTS = (".yaml", ".yml", ".json", ".toml", ".xml", ".txt", ".csv", ".cam", ".cal", ".xcp", ".npz", ".dat")
_IMAGES = (".png", ".jpg", ".jpeg")
#: Suffix of skeleton files: an AMC motion needs one.
_SKELETON = ".asf"


# --- kinds


@dataclass(frozen=True)
class FileKind:
    """A kind of file that can be uploaded.

    Attributes:
        name: Name of the kind for users, such as ``a mesh``.
        suffixes: Suffixes of such files, in lower case.
        read: Reads a file; raises HumansimError if the file is not of this kind.
    """

    name: str
    suffixes: tuple[str, ...]
    read: Callable[[Path], object]


def _person(path: Path) -> object:
    if path.suffix.lower() in (".yaml", ".yml"):
        check_value(path.parent, read_yaml(path, HumansimError, "human")[0])  # it names files
        return load_human(path)
    return load_human(path) if path.suffix.lower() == ".npz" else read_mesh_or_figure(path)


def _views(path: Path) -> object:
    data = read_yaml(path, HumansimError, "views file")[0]
    if not isinstance(data, dict) or "views" not in data:
        raise HumansimError("it has no key 'views' (docs/from_photographs.md)")
    check_value(path.parent, data)
    return data


def _image(path: Path) -> object:
    return decode_image(read_bytes(path, HumansimError, "image", MOST_UPLOAD))


KINDS: Mapping[str, FileKind] = {
    "body": FileKind("a mesh of a person, or a human", HUMAN_SUFFIXES, _person),
    "motion": FileKind(
        "a motion of a person",
        tuple(suffix for suffix in MOTION_SUFFIXES if suffix != _SKELETON),
        lambda path: match_motion(read_motion(path)),
    ),
    "calibration": FileKind("a calibration", _TEXTS, lambda path: load_calibration(path, all_cameras=True)),
    "mesh": FileKind("a mesh", tuple(MESH_SUFFIXES), read_mesh),
    "joint table": FileKind("a joint table", (".yaml", ".yml"), load_table),
    "keyframes": FileKind("a keyframe file", (".xml",), read_keyframes),
    "image": FileKind("an image", _IMAGES, _image),
    "estimate": FileKind("an estimate of a tracker", ESTIMATE_SUFFIXES, lambda path: None),
    "views": FileKind("a views file of photographs", (".yaml", ".yml"), _views),
    "companion": FileKind(
        "a file that others name",
        (_SKELETON, ".mtl", ".bin", ".txt", ".csv", ".tum", ".hdr", ".exr", *_IMAGES, *_TEXTS),
        lambda path: None,
    ),
}
#: Kind of the files that a key of a scene names, by the last part of the key, or by its last two parts.
_KIND_OF_KEY = {
    "body": "body",
    "mesh": "mesh",
    "calibration": "calibration",
    "joint_names": "joint table",
    "background": "image",
    "environment": "companion",
    "motion.file": "motion",
    "keyframes.file": "keyframes",
    "rig.file": "calibration",
    "trajectory.file": "companion",
    "meshes.file": "mesh",
}


def kind_of_key(keys: tuple[Any, ...]) -> str | None:
    """Kind (key of :data:`KINDS`) of the files that a key of a scene names; None if it names none."""
    words = [str(key) for key in keys]
    return _KIND_OF_KEY.get(".".join(words[-2:])) or _KIND_OF_KEY.get(words[-1])


# --- in the folder of the scene


def plain_name(name: str, suffixes: tuple[str, ...]) -> str:
    """Make a safe file name: letters, digits, ``_``, ``-`` and the suffix, without folders.

    Raises:
        HumansimError: The suffix is not one of ``suffixes``.
    """
    last = re.split(r"[/\\]", name)[-1]
    text = unicodedata.normalize("NFKD", last).encode("ascii", "ignore").decode()
    stem, dot, ending = text.rpartition(".")
    suffix = f".{ending}".lower() if dot else ""
    if suffix not in suffixes:
        raise HumansimError(
            f"{printable(last, 60)}: this is {f'a {suffix} file' if dot else 'a file without suffix'}; "
            f"needed is one of {', '.join(suffixes)}"
            if re.fullmatch(r"\.[a-z0-9]{1,8}|", suffix)
            else f"{printable(last, 60)}: needed is one of {', '.join(suffixes)}"
        )
    plain = re.sub(r"[^A-Za-z0-9_-]+", "_", stem).strip("_-")[:_LONGEST]
    return (plain or "file") + suffix


def keep_file(folder: Path, name: str, content: bytes, kind: str) -> Path:
    """Save an uploaded file in the folder of the scene, if the file is of the expected kind.

    If another file has the same name but other content, a number is added to the name of the new file.

    Args:
        folder: Folder of the scene; made if it does not exist.
        name: Name of the file in the browser.
        content: Content of the file.
        kind: Key of :data:`KINDS`.

    Returns:
        Path of the saved file.

    Raises:
        HumansimError: The file is of another kind, too large, or cannot be written.
    """
    wanted = KINDS[kind]
    plain = plain_name(name, wanted.suffixes)
    if not 0 < len(content) <= MOST_UPLOAD:
        raise HumansimError(f"{plain}: {size_text(len(content))}; a file has 1 B to {size_text(MOST_UPLOAD)}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for target in _names(folder, plain):
            if not os.path.lexists(target):
                break
            if target.is_file() and not target.is_symlink() and target.read_bytes() == content:
                return target
        # in the same folder, because the check of a mesh also reads the files that the mesh names
        handle, temporary = tempfile.mkstemp(suffix=target.suffix, prefix=f".{target.stem}-", dir=folder)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content)
            _check(Path(temporary), plain, wanted)
            Path(temporary).chmod(0o644)
            Path(temporary).replace(target)
        finally:
            Path(temporary).unlink(missing_ok=True)
    except OSError as error:
        raise HumansimError(f"{plain} cannot be kept in {folder}: {error.strerror or error}") from None
    return target


def files_in(folder: Path, kind: str | None) -> list[str]:
    """Sorted names of files in a folder with a suffix of a kind (key of :data:`KINDS`); None finds none."""
    if kind is None or not exists(folder):
        return []
    suffixes = KINDS[kind].suffixes
    found = []
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                name = entry.name
                if name.startswith(".") or Path(name).suffix.lower() not in suffixes or not entry.is_file():
                    continue
                found.append(name)
    except OSError:
        return []
    inner = []
    for name in found:
        try:
            inside(folder, name)  # not a link to another place
        except HumansimError:
            continue
        inner.append(name)
    return sorted(inner)[:_MOST_FILES]


def _check(path: Path, name: str, kind: FileKind) -> None:
    """Check that a file can be read as its kind. Errors call the file ``name``, not its temporary path."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            kind.read(path)
        except HumansimError as error:
            reason = str(error).replace(str(path), name).replace(path.name, name)
            raise HumansimError(f"{name} is not {kind.name}: {reason}") from None


def _names(folder: Path, name: str) -> Iterator[Path]:
    """Candidate paths for a new file: ``name``, then ``name`` with the numbers 2, 3, ... added."""
    stem, suffix = Path(name).stem, Path(name).suffix
    yield folder / name
    for number in range(2, 10_000):
        yield folder / f"{stem}_{number}{suffix}"
    raise HumansimError(f"{folder} has too many files that are called {name}")
