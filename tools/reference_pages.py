"""The pages of docs/reference/ that are made from the code: scene keys, topics, commands.

``python tools/doc_pages.py`` writes them, and a test compares them with their sources: the schema of scene
files, the table of topics, and the command line.
"""

from __future__ import annotations

import inspect
import json
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from pydantic import BaseModel
from typer.models import ArgumentInfo, ParameterInfo

ROOT = Path(__file__).resolve().parents[1]
REFERENCE = ROOT / "docs" / "reference"


def row(cells: Iterable[str]) -> str:
    """A row of a table; a bar in a cell is escaped."""
    escaped = (re.sub(r"(?<!\\)\|", r"\|", cell) for cell in cells)
    return f"| {' | '.join(escaped)} |"


def table(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a table."""
    return [row(titles), row("---" for _ in titles), *map(row, rows)]


# --- keys of scene files

_KEYS_HEAD = """# Keys of scene files

All keys of a [scene file](../scene.md), with the values that they take. `tools/doc_pages.py` makes this page
from the schema (`humansim_ros/scene/config/config.py`) by which files are checked. In the names of sections,
`*` stands for a name that you choose.
"""


#: Pages that explain sections.
_GUIDES = {
    "humans.*": "humans.md",
    "humans.*.motion": "motion.md",
    "humans.*.keyframes": "keyframes.md",
    "variety": "humans.md#many-humans",
    "objects.*": "scene.md#furniture",
    "cameras.*": "cameras.md",
    "cameras.*.trajectory": "rigs.md#cameras-that-move",
    "cameras.*.sensor": "sensors.md",
    "cameras.*.depth_sensor": "depth_cameras.md",
    "cameras.*.stereo": "depth_cameras.md#stereo-pairs",
    "scanners.*": "scanners.md",
    "cameras.*.faults": "faults.md",
    "world": "look.md#environments",
    "light": "look.md#light",
    "randomise": "look.md#random-variation",
    "time": "lockstep.md",
    "rig": "rigs.md",
}


def scene_keys_page() -> str:
    """docs/reference/scene_keys.md."""
    from humansim_ros.scene.config.config import SceneConfig

    sections = list(_sections(SceneConfig, ""))
    first: dict[type, str] = {}
    for path, model in sections:
        first.setdefault(model, path)
    lines = [_KEYS_HEAD]
    for path, model in sections:
        if first[model] == path:
            others = [other for other, same in sections if same is model and other != path]
            lines += [*_section(path, model, others, first), ""]
    return "\n".join(lines)


def _sections(model: type[Any], path: str) -> Iterator[tuple[str, type[Any]]]:
    """The paths and models of a section and of those within it."""
    yield path, model
    fields = model.model_fields
    # a camera has all sections that a rig has, and is the better place for them
    names = sorted(fields, key=lambda name: name == "rig")
    for name in names:
        for part, mark in _models(fields[name].annotation):
            yield from _sections(part, f"{path}.{name}{mark}".lstrip("."))


def _models(annotation: Any, mark: str = "") -> Iterator[tuple[type[Any], str]]:
    """Models in the annotation of a field; the mark says that names come between."""
    if isinstance(annotation, type) and hasattr(annotation, "model_fields"):
        yield annotation, mark
        return
    is_mapping = getattr(annotation, "__origin__", None) is dict
    for part in get_args(annotation):
        yield from _models(part, ".*" if is_mapping else mark)


def _anchor(heading: str) -> str:
    """Anchor of a heading, as GitHub and the site make it."""
    return "#" + re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def _section(path: str, model: type[Any], others: Sequence[str], first: Mapping[type, str]) -> Iterator[str]:
    from humansim_ros.files.yaml.schema import allowed

    level = min(2 + path.replace(".*", "").count("."), 4)
    yield f"{'#' * level} {path or 'The file'}\n"
    yield _summary(model) + "\n"
    if short := getattr(model, "short_key", None) or getattr(model, "number_key", None):
        kind = "A text" if hasattr(model, "short_key") else "A number"
        yield f"{kind} alone stands for its key `{short}`.\n"
    if path in _GUIDES:
        yield f"More in [{_GUIDES[path].partition('#')[0]}](../{_GUIDES[path]}).\n"
    if others:
        yield f"The same keys as {_and(f'`{other}`' for other in others)}.\n"
    rows = []
    for name, field in model.model_fields.items():
        inner = [part for part, _ in _models(field.annotation)]
        if inner:
            target = first[inner[0]]
            values = f"the keys of [`{target}`]({_anchor(target)})"
            if any(mark for _, mark in _models(field.annotation)):
                values = f"names, each with {values}"
        else:
            values = allowed(field.annotation, field)
        meaning = field.description or (_summary(inner[0]) if inner else "")
        rows.append((f"`{name}`", values, _default(field), meaning))
    yield from table(("key", "value", "default", "meaning"), rows)


def _summary(documented: Any) -> str:
    """The docstring as one line."""
    return re.sub(r"\s*\n\s*", " ", inspect.getdoc(documented) or "")


def _default(field: Any) -> str:
    value = field.default
    if field.is_required():
        return "must be given"
    if value is None or field.default_factory is not None or isinstance(value, BaseModel):
        return ""
    text = re.sub(r"\.0\b", "", json.dumps(value, ensure_ascii=False))
    return f"`{text.strip(chr(34))}`" if value != () else "none"


def _and(words: Iterable[str]) -> str:
    every = list(words)
    return " and ".join([", ".join(every[:-1]), every[-1]] if len(every) > 1 else every)


# --- topics

_TOPICS_HEAD = """# Topics and messages

All topics of a scene, from the table by which nodes publish and recordings are written
(`humansim_ros/data/messages/topics.py`). `tools/doc_pages.py` makes this page; the meanings come from
[the table of topics](../topics.md) and from [ground truth](../ground_truth.md), which defines every number.
Names are relative to the namespace of the nodes.

- *each frame*: a message for each frame, with its stamp. Quality of service: reliable, volatile, depth
  {depth}.
- *once*: latched (transient local, depth 1): a late subscriber gets it, too. Topics that are sent each frame
  *if the camera moves* are latched as well.
- *recorded*: `humansim record` writes it unless you name topics; *on request*: only if you name it.
"""
_SCENE = """
humans: {id: {}, live: {motion: live}}
objects: {object: {keyframes: moves.xml}}
cameras:
  camera:
    size: [64, 48]
    fov_deg: 60
    distortion: [-0.1, 0, 0, 0]
    trajectory: way.txt
    faults: {calibration: {translation: 0.01}}
    depth_sensor: kinect_v1
scanners:
  scanner: {model: velodyne_vlp16, trajectory: way.txt}
  plane: {model: hokuyo_utm30lx, trajectory: way.txt}
adapters: {detections_2d: {}, detections_3d: {}, people: {}, tracked_persons: {}}
"""
_MOVES = """<animation startframe="0" endframe="10" rate="10"><object name="object">
<frame number="0"><position x="0" y="0" z="1"/></frame>
<frame number="10"><position x="1" y="0" z="1"/></frame>
</object></animation>"""
_WAY = "0 3 0 1 0 0 0 1\n1 3 1 1 0 0 0 1\n"


def _all_topics() -> list[Any]:
    """Topics of a scene that has some of everything."""
    import yaml

    from humansim_ros.data.messages.topics import scene_topics
    from humansim_ros.scene import Scene

    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "moves.xml").write_text(_MOVES)
        (Path(folder) / "way.txt").write_text(_WAY)
        return scene_topics(Scene.from_dict(yaml.safe_load(_SCENE), folder))


def _pattern(name: str) -> str:
    """Name of a topic with placeholders, as the documents write it."""
    from humansim_ros.people import KEYPOINT_SETS

    name = re.sub(r"^humans/\w+", "humans/<id>", name)
    name = re.sub(r"^objects/\w+", "objects/<name>", name)
    name = re.sub(r"^camera\b", "<camera>", name)
    name = re.sub(r"^(scanner|plane)\b", "<scanner>", name)
    name = re.sub(r"(alpha|amodal)/\w+", r"\1/<name>", name)
    return re.sub(rf"keypoints/({'|'.join(KEYPOINT_SETS)})$", "keypoints/<set>", name)


def described_topics() -> dict[str, tuple[str, str]]:
    """Type and meaning of each topic in the table of docs/topics.md, by its name without the first slash."""
    rows = re.findall(
        r"^\| (`/.*?) \| (.*?) \| (.*?) \|$", (ROOT / "docs" / "topics.md").read_text("utf-8"), re.MULTILINE
    )
    found: dict[str, tuple[str, str]] = {}
    for names, kind, meaning in rows:
        meaning = re.sub(r"\]\((\w+\.md)", r"](../\1", meaning)
        for name in re.findall(r"`(.*?)`", names):
            root = "" if name.startswith("/") else f"{names.split('/')[1]}/"
            found[root + name.lstrip("/")] = kind, meaning
    return found


def channel_topics() -> dict[str, str]:
    """Content of the images of the channels, by topic, from the table of docs/ground_truth.md."""
    text = (ROOT / "docs" / "ground_truth.md").read_text("utf-8").partition("| topic | type and content |")[2]
    found: dict[str, str] = {}
    for names, content in re.findall(r"^\| (`.*?) \| (.*?) \|", text.partition("\n\n")[0], re.MULTILINE):
        for name in re.findall(r"`(.*?)`", names):
            found[f"<camera>/{name}"] = re.sub(r"\]\((\w+\.md)", r"](../\1", content)
    return found


def topics_page() -> str:
    """docs/reference/topics.md. Raises KeyError for a topic that docs/topics.md does not name."""
    from humansim_ros.ros.graph.qos import DATA

    known, images = described_topics(), channel_topics()
    groups: dict[str, dict[tuple[str, ...], list[str]]] = {
        "Scene": {},
        "Humans": {},
        "Objects": {},
        "Cameras": {},
        "Laser scanners": {},
    }
    titles = {
        "humans": "Humans",
        "objects": "Objects",
        "<camera>": "Cameras",
        "<scanner>": "Laser scanners",
    }
    shown: set[str] = set()
    for topic in _all_topics():
        name = _pattern(topic.name)
        if name in shown:
            continue
        shown.add(name)
        place = name if name in known else re.sub(r"[^/]+/camera_info$", "part/camera_info", name)
        if place not in known:
            raise KeyError(f"docs/topics.md lacks /{name}")
        sent = "each frame" if topic.per_frame else "once"
        if topic.latched and topic.per_frame:
            sent = f"each frame, if the {'scanner' if name.startswith('<scanner>') else 'camera'} moves"
        if topic.scanner:
            sent = "each sweep"
        recorded = "; recorded on request" if topic.optional else "; recorded" if topic.recorded else ""
        what = (topic.type_name.replace("/msg/", "/"), sent + recorded, images.get(name, known[place][1]))
        groups[titles.get(name.split("/")[0], "Scene")].setdefault(what, []).append(f"`{name}`")
    lines = [_TOPICS_HEAD.format(depth=DATA.depth)]
    for title, group in groups.items():
        rows = [("<br>".join([*names, kind]), *rest) for (kind, *rest), names in group.items()]
        lines += [f"## {title}\n", *table(("topic, type", "sent", "meaning"), rows), ""]
    others = [
        (f"`{name}`<br>{kind}", meaning)
        for name, (kind, meaning) in known.items()
        if name not in shown and not name.endswith("camera_info")
    ]
    lines += ["## Of the nodes themselves\n", "They are about the run, not about the scene.\n"]
    lines += [*table(("topic, type", "meaning"), others), "", *_clouds()]
    return "\n".join(lines)


def _clouds() -> Iterator[str]:
    """Fields of the point clouds."""
    from humansim_ros.data import messages
    from humansim_ros.data.messages.camera_truth import BOX_POINT, JOINT_POINT, VISIBLE_VERTEX
    from humansim_ros.data.messages.points import XYZ_POINT, XYZRGB_POINT
    from humansim_ros.data.messages.scanners import SCANNER_TRUTH

    yield "## Fields of the point clouds\n"
    yield (
        "Points are NumPy structured arrays with padding between fields; all numbers are little-endian.\n"
        "`humansim_ros.data.messages` has a reader for each; see [ground truth](../ground_truth.md).\n"
    )
    clouds = {
        "<camera>/joints": (JOINT_POINT, messages.read_joint_view),
        "<camera>/keypoints/<set>": (JOINT_POINT, messages.read_joint_view),
        "<camera>/boxes": (BOX_POINT, messages.read_boxes),
        "<camera>/depth_sensor/points": (XYZ_POINT, messages.read_points),
        "<camera>/points": (XYZRGB_POINT, messages.read_points),
        "<camera>/visible_vertices": (VISIBLE_VERTEX, messages.read_visible_vertices),
        "<scanner>/truth/points": (SCANNER_TRUTH, messages.read_scanner_truth),
    }
    yield from table(
        ("topic", "fields (type, first byte)", "bytes", "reader"),
        (
            (
                f"`{topic}`",
                ", ".join(
                    f"`{name}` ({kind.name}, {offset})" for name, (kind, offset, *_) in dtype.fields.items()
                ),
                str(dtype.itemsize),
                f"`{reader.__name__}`",
            )
            for topic, (dtype, reader) in clouds.items()
        ),
    )
    yield ""


# --- commands

_COMMANDS_HEAD = """# Commands

All commands with their arguments and options, as `humansim COMMAND --help` prints them; `tools/doc_pages.py`
makes this page from the command line. Exit codes: 0 success; 1 a check or a run failed; 2 wrong input or a
wrong command, with a message that names file, line and key. Commands with `--json` print for programs.
"""


def commands_page() -> str:
    """docs/reference/commands.md."""
    from humansim_ros.cli.main import COMMANDS, GROUPS, load_command

    groups: dict[str, dict[str, Any]] = {"": {}} | {group: {} for group in GROUPS}
    for name in COMMANDS:
        groups[name.rpartition(" ")[0]][f"humansim {name}"] = load_command(name)
    lines = [_COMMANDS_HEAD]
    for functions in groups.values():
        lines += [*_overview(functions), ""]
    for group, functions in groups.items():
        lines += [f"## humansim {group}\n", f"{GROUPS[group]}\n"] if group else []
        for name, function in functions.items():
            lines += _command(name, function, 3 if group else 2)
    return "\n".join(lines)


def _overview(functions: Mapping[str, Any]) -> list[str]:
    rows = [
        (f"[`{name}`]({_anchor(name)})", re.split(r"[.:] ", _summary(function))[0].rstrip("."))
        for name, function in functions.items()
    ]
    return table(("command", "does"), rows)


def _command(name: str, function: Any, level: int) -> Iterator[str]:
    """Section of a command, from the signature of its function."""
    arguments: list[tuple[str, str, str]] = []
    options: list[tuple[str, str, str]] = []
    hints = get_type_hints(function, include_extras=True)
    for parameter in inspect.signature(function).parameters.values():
        kind, *details = get_args(hints[parameter.name])
        info = next(detail for detail in details if isinstance(detail, ParameterInfo))
        required = parameter.default is parameter.empty
        value = "must be given" if required else _shown(parameter.default, info)
        if isinstance(info, ArgumentInfo):
            word = info.metavar or parameter.name.upper()
            word += "..." if list in (kind, get_origin(kind), *map(get_origin, get_args(kind))) else ""
            arguments.append((word if required or word[0] == "[" else f"[{word}]", "", info.help or ""))
        else:
            options.append((_option(parameter.name, kind, info), value, info.help or ""))
    yield f"{'#' * level} {name}\n"
    yield _summary(function) + "\n"
    words = [name, *(word for word, _, _ in arguments), *(["[OPTIONS]"] if options else [])]
    yield f"```text\n{' '.join(words)}\n```\n"
    rows = [(f"`{word}`", value, text) for word, value, text in arguments] + options
    if rows:
        yield from table(("argument or option", "default", "meaning"), rows)
        yield ""


def _option(name: str, kind: Any, info: ParameterInfo) -> str:
    """Names of an option, and the kind of its value."""
    long = "--" + name.replace("_", "-")
    parts = {kind, get_origin(kind), *get_args(kind)}
    # typer takes the first name in an annotation for a default
    given = [each for each in (info.default, *(info.param_decls or ())) if str(each).startswith("-")]
    if bool in parts:
        return ", ".join(f"`{each}`" for each in given or [f"{long}/--no-{long.removeprefix('--')}"])
    names = sorted(given or [long], key=len)
    words = {int: "INTEGER", float: "NUMBER", Path: "PATH"}
    scalars = [part for part in _scalars(kind) if part is not type(None)]
    value = info.metavar or " ".join(_choices(part) or words.get(part, "TEXT") for part in scalars)
    return f"{', '.join(f'`{each}`' for each in names)} {value}"


def _choices(kind: Any) -> str:
    """Words of a choice, such as ``png|jpg``; empty for another type."""
    words = get_args(kind) if get_origin(kind) is Literal else getattr(kind, "__members__", {}).values()
    return "|".join(str(getattr(word, "value", word)) for word in words)


def _scalars(kind: Any) -> list[Any]:
    """Types of the single values in an annotation."""
    if get_origin(kind) is Literal:
        return [kind]
    inner = [part for part in get_args(kind) if part is not Ellipsis]
    return [scalar for part in inner for scalar in _scalars(part)] if inner else [kind]


def _shown(value: Any, info: ParameterInfo) -> str:
    if value is True:
        return "on"
    if value is None or value in ("", [], (), False) or not info.show_default:
        return ""
    words = value if isinstance(value, (list, tuple)) else [value]
    return f"`{' '.join(str(getattr(word, 'value', word)) for word in words)}`"


PAGES = {"scene_keys.md": scene_keys_page, "topics.md": topics_page, "commands.md": commands_page}


def write() -> None:
    """Write all pages."""
    REFERENCE.mkdir(exist_ok=True)
    for name, page in PAGES.items():
        (REFERENCE / name).write_text(page(), encoding="utf-8")
