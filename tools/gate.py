"""Hash what the package produces, so that a change of its structure can be shown to change nothing else.

    python tools/gate.py write FILE                # everything, as JSON
    python tools/gate.py write FILE --only scenes exports
    python tools/gate.py compare BEFORE AFTER      # prints each entry that differs; exit code 1 if any does

Sections: ``schema`` (files of schemas), ``interface`` (public names with signatures, fields and attributes),
``scenes`` (messages of all topics of each scene in ``config/scenes`` and of a scene with every feature),
``exports`` (files of each export format), ``recipe`` (files of the data set of a recipe).
Two runs of the same code give the same file. The package is used by its public names only.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import importlib
import inspect
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]
#: Folders whose ``__all__`` is public, by docs/api.md; ``""`` is the package itself.
PUBLIC = (
    *("", "apps", "bags", "body", "camera", "humans", "keypoints", "mesh", "motion", "photographs"),
    *("render", "scene", "sensor", "truth"),
)
#: Frames of each scene: enough that cameras of half the rate and sweeps of scanners have results.
FRAMES = 7
#: Frames of scenes in which a frame takes seconds.
FEWER_FRAMES = {"crowd": 2}
#: Export formats whose files differ from run to run (random identifiers).
NOT_REPEATED = ("rerun",)
#: Formats that the scene with every feature is exported to: those that can hold moving cameras.
EXPORTS_OF_ALL = ("images", "coco", "nuscenes", "foxglove", "bvh", "glb", "usd", "mujoco", "trc")
#: Text that differs from run to run: the moment, temporary folders, and the hash of a scene with their names.
_VOLATILE = re.compile(
    rb"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d[^\"'<]*|"
    + re.escape(tempfile.gettempdir()).encode()
    + rb"/tmp\w+|(?<=\"scene\": \")[0-9a-f]{64}"
)

Section = dict[str, str]


def sha(content: bytes | str) -> str:
    """Start of the SHA-256 of a text or of bytes."""
    return hashlib.sha256(content.encode() if isinstance(content, str) else content).hexdigest()[:20]


def schema() -> Section:
    """Hashes of the files of schemas."""
    return {path.name: sha(path.read_bytes()) for path in sorted((ROOT / "config").glob("*.schema.json"))}


def _described(value: Any) -> str:
    """Kind and signature of a public name."""
    if inspect.isclass(value) or callable(value):
        try:
            return f"{'class' if inspect.isclass(value) else 'function'} {inspect.signature(value)}"
        except (ValueError, TypeError):
            return "class" if inspect.isclass(value) else "callable"
    return type(value).__name__


def _attributes(kind: type) -> dict[str, str]:
    """Public attributes of a class that the package defines, also those of its bases in the package."""
    found: dict[str, str] = {}
    own = [base for base in kind.__mro__ if base.__module__.startswith("humansim_ros")]
    for base in reversed(own):
        for name in inspect.get_annotations(base):
            if not name.startswith("_"):
                found[name] = "field"
        for name, value in base.__dict__.items():
            if not name.startswith("_"):
                value = getattr(value, "__func__", value)
                found[name] = "property" if not callable(value) else _described(value)
    if dataclasses.is_dataclass(kind):
        found |= {field.name: "field" for field in dataclasses.fields(kind) if not field.name.startswith("_")}
    if issubclass(kind, Enum):
        found |= {member.name: "member" for member in kind}
    return found


def interface() -> Section:
    """Public names with their signatures, and the attributes of public classes."""
    found = {}
    for folder in PUBLIC:
        module = importlib.import_module(".".join(filter(None, ("humansim_ros", folder))))
        for name in sorted(module.__all__):
            value = getattr(module, name)
            place = ".".join(filter(None, (folder, name)))
            # addresses of default values are not part of a signature; neither are modules, which may move
            found[place] = _stable(_described(value))
            if inspect.isclass(value):
                for attribute, kind in _attributes(value).items():
                    found[f"{place}.{attribute}"] = _stable(kind)
    return found


def _stable(text: str) -> str:
    return re.sub(r"humansim_ros\.[a-z_.]*\.", "", re.sub(r" at 0x[0-9a-f]+", "", text))


def scene_hashes(path: Path, frames: int, folder: Path) -> Section:
    """Hash of each topic of a recording of a scene, over all its messages with stamps."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    import humansim_ros

    bag = humansim_ros.record(path, folder / path.stem, frames=frames, topics=["*"], jobs=1)
    hashes: dict[str, Any] = {}
    counts: dict[str, int] = {}
    with AnyReader([Path(bag)], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        for connection, time, data in reader.messages():
            topic = f"{connection.topic} {connection.msgtype}"
            hashes.setdefault(topic, hashlib.sha256()).update(f"{time} {len(data)} ".encode() + bytes(data))
            counts[topic] = counts.get(topic, 0) + 1
    return {topic: f"{counts[topic]} {digest.hexdigest()[:20]}" for topic, digest in sorted(hashes.items())}


def every_feature(folder: Path) -> Path:
    """Scene with every section and every kind of human, object, camera and scanner."""
    sys.path[:0] = [str(ROOT / "test"), str(ROOT / "test" / "scene")]
    from everything import everything

    path = folder / "every_feature.yaml"
    path.write_text(yaml.safe_dump(everything(folder), sort_keys=False))
    return path


def scenes() -> Section:
    """Hashes of the topics of all scenes."""
    found = {}
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        files = [*sorted((ROOT / "config" / "scenes").glob("*.yaml")), every_feature(folder)]
        for path in files:
            _say(path.stem)
            one = scene_hashes(path, FEWER_FRAMES.get(path.stem, FRAMES), folder / "bags")
            found |= {f"{path.stem} {topic}": digest for topic, digest in one.items()}
    return found


def file_hashes(folder: Path) -> Section:
    """Hash of each file of a folder, without what differs from run to run."""
    return {
        str(path.relative_to(folder)): sha(_VOLATILE.sub(b"", path.read_bytes()))
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def exports() -> Section:
    """Hashes of the files of each export format, of a scene with scanners and of that with every feature."""
    import humansim_ros

    found: Section = {}
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        sources = {
            ROOT / "config" / "scenes" / "scanners.yaml": _format_names(),
            every_feature(folder): EXPORTS_OF_ALL,
        }
        for scene, names in sources.items():
            out = folder / scene.stem
            chosen = [name for name in names if name not in NOT_REPEATED]
            humansim_ros.export(scene, out, formats=chosen, frames=FRAMES, jobs=1)
            found |= {f"{scene.stem}/{path}": digest for path, digest in file_hashes(out).items()}
    return found


def recipe() -> Section:
    """Hashes of the files of a small data set that a recipe makes."""
    import humansim_ros

    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        keys = yaml.safe_load((ROOT / "config" / "recipes" / "people.yaml").read_text())
        keys |= {"scenes": 3, "frames": 2, "splits": {"train": 1, "val": 1, "test": 1}}
        path = folder / "people.yaml"
        path.write_text(yaml.safe_dump(keys, sort_keys=False))
        humansim_ros.export(path, folder / "out", jobs=1)
        return file_hashes(folder / "out")


def _format_names() -> list[str]:
    """Names of all export formats, as the command lists them."""
    command = [sys.executable, "-m", "humansim_ros", "export", "--list"]
    listed = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout
    return [line.split()[0] for line in listed.splitlines() if line[:1].strip()]


SECTIONS: Mapping[str, Callable[[], Section]] = {
    "schema": schema,
    "interface": interface,
    "scenes": scenes,
    "exports": exports,
    "recipe": recipe,
}


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def differences(before: Mapping[str, Section], after: Mapping[str, Section]) -> list[str]:
    """A line for each entry of two runs that differs, in the sections that both have."""
    lines = []
    for section in SECTIONS:
        if section not in before or section not in after:
            continue
        first, second = before[section], after[section]
        lines += [f"{section}: {key} is gone" for key in first.keys() - second.keys()]
        lines += [f"{section}: {key} is new" for key in second.keys() - first.keys()]
        lines += [
            f"{section}: {key}: {first[key]} -> {second[key]}"
            for key in first
            if first[key] != second.get(key, first[key])
        ]
    return sorted(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the hashes to a file, or compare two files."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    write = commands.add_parser("write", help="hash everything")
    write.add_argument("file", type=Path)
    write.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS), metavar="SECTION")
    compare = commands.add_parser("compare", help="print what differs")
    compare.add_argument("before", type=Path)
    compare.add_argument("after", type=Path)
    options = parser.parse_args(arguments)
    if options.command == "write":
        found: dict[str, Section] = {}
        for section in options.only:
            _say(section)
            found[section] = SECTIONS[section]()
        options.file.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n")
        return 0
    before, after = (json.loads(path.read_text()) for path in (options.before, options.after))
    lines = differences(before, after)
    print("\n".join(lines) if lines else "nothing differs")
    return int(bool(lines))


if __name__ == "__main__":
    sys.exit(main())
