"""Suites of the challenge: a base scene, and difficulties (axes). Each axis changes the scene in three
strengths."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, StringConstraints

from humansim_ros.errors import ChallengeError, HumansimError, unknown
from humansim_ros.files.reading import resource_path
from humansim_ros.files.yaml import Section, Share, line_of, read_yaml, validated
from humansim_ros.scene.config import SceneConfig, check_config

#: Name of the suite that the package brings.
STANDARD = "standard"
#: Strengths of each axis.
STRENGTHS = 3
#: Name of the case without a difficulty.
BASELINE = "baseline"
#: Sections of a scene file with names as keys. An overlay can use null to remove a name, ``*`` for all.
_NAMED = ("humans", "objects", "cameras")
#: Most suites in a chain in which each extends the next.
_MAX_DEPTH = 10
#: Pattern of the names of axes, which are also used as names of files.
_NAME = re.compile(r"[a-z0-9_]{1,40}")

_Overlay = Annotated[dict[str, Any], Field(description="keys of a scene that change")]
_Label = Annotated[str, StringConstraints(min_length=1, max_length=40)]


class StrengthConfig(Section):
    """One strength of a difficulty."""

    label: Annotated[_Label, Field(description="words for the table")]
    scene: _Overlay


class AxisConfig(Section):
    """A difficulty, from its weakest to its strongest."""

    title: Annotated[_Label, Field(description="name in tables and pictures")]
    group: Annotated[_Label, Field(description="heading above it")] = "Other"
    patience: Annotated[
        float | None, Field(gt=0, le=1000, description="seconds that a frame waits for the tracker")
    ] = None
    strengths: Annotated[
        list[StrengthConfig], Field(min_length=STRENGTHS, max_length=STRENGTHS, description="three strengths")
    ]


class QuickConfig(Section):
    """The short form of a suite."""

    frames: Annotated[int, Field(ge=2, le=100_000, description="frames of a case")] = 24
    strengths: Annotated[
        tuple[Annotated[int, Field(ge=1, le=STRENGTHS)], ...],
        Field(min_length=1, description="strengths to run"),
    ] = (STRENGTHS,)


class SuiteConfig(Section):
    """Content of a suite file."""

    name: Annotated[_Label, Field(description="name of the suite")]
    version: Annotated[_Label, Field(description="version of the suite, a text")]
    frames: Annotated[int, Field(ge=2, le=100_000, description="frames of a case")] = 60
    breaks_below: Annotated[Share, Field(description="share of the score of the baseline")] = 0.7
    quick: QuickConfig = QuickConfig()
    scene: _Overlay
    axes: dict[str, AxisConfig]


@dataclass(frozen=True)
class Case:
    """A run of the tracker in one scene: the baseline, or a difficulty with a strength.

    Attributes:
        axis: Name of the difficulty. ``baseline`` for no difficulty.
        strength: 1 to 3. 0 for the baseline.
        label: Text that describes the strength.
        scene: Content of the scene file, with absolute paths.
        frames: Number of frames.
        patience: Seconds that a frame waits for the tracker. If None, the timeout that the user has set.
    """

    axis: str
    strength: int
    label: str
    scene: SceneConfig
    frames: int
    patience: float | None

    @property
    def name(self) -> str:
        """Name of the case and of its files, such as ``people_3``."""
        return f"{self.axis}_{self.strength}" if self.strength else self.axis


@dataclass(frozen=True)
class Suite:
    """A suite that is ready to run. ``axes``: all axes. ``cases``: the baseline, then the cases to run."""

    name: str
    version: str
    breaks_below: float
    axes: Mapping[str, AxisConfig]
    cases: Sequence[Case]


def load_suite(path: Path | None = None, only: Sequence[str] = (), quick: bool = False) -> Suite:
    """Load a suite.

    Args:
        path: YAML file. If None, the suite of the package.
        only: Names of axes. If empty, all axes.
        quick: Whether to use the short form, with fewer frames and strengths.

    Raises:
        HumansimError: The file, one of its scenes, or a name in ``only`` is wrong.
    """
    source = path or resource_path(f"config/challenge/{STANDARD}.yaml")
    content, tree = _read(source, 0)
    config = validated(SuiteConfig, content, ChallengeError, source, tree)
    for name in config.axes:
        if not _NAME.fullmatch(name) or name == BASELINE:
            raise ChallengeError(
                "the name of an axis has lower-case letters, digits and _, and is not baseline",
                path=source,
                line=line_of(tree, ["axes", name]),
                key=f"axes.{name}",
            )
    for name in only:
        if name not in config.axes:
            raise ChallengeError(unknown("axis", name, config.axes, f"the suite {config.name}"), key="--only")
    frames = config.quick.frames if quick else config.frames
    strengths = config.quick.strengths if quick else range(1, STRENGTHS + 1)

    def case(axis: str, strength: int, label: str, overlay: Any, keys: list[Any], wait: float | None) -> Case:
        try:
            scene = check_config(overlaid(config.scene, overlay))
        except HumansimError as error:
            where = ".".join(map(str, keys))
            raise ChallengeError(
                str(error), path=source, line=line_of(tree, keys), key=where
            ) from error.__cause__
        return Case(axis, strength, label, scene, frames, wait)

    cases = [case(BASELINE, 0, BASELINE, {}, ["scene"], None)]
    for name, axis in config.axes.items():
        if only and name not in only:
            continue
        for index in sorted({strength - 1 for strength in strengths}):
            each = axis.strengths[index]
            keys = ["axes", name, "strengths", index, "scene"]
            cases.append(case(name, index + 1, each.label, each.scene, keys, axis.patience))
    return Suite(config.name, config.version, config.breaks_below, config.axes, cases)


def _read(path: Path, depth: int) -> tuple[Any, Any]:
    """Read a suite file. Returns its content, merged with the suite that it extends; and its YAML nodes."""
    content, tree = read_yaml(path, ChallengeError, "suite")
    if not isinstance(content, dict):
        raise ChallengeError("a suite is a mapping with 'name', 'version', 'scene' and 'axes'", path=path)
    base = content.pop("extends", None)
    content = _with_absolute_files(content, path.resolve().parent)
    if base is None:
        return content, tree
    if not isinstance(base, str) or depth >= _MAX_DEPTH:
        reason = "give the name of a suite" if depth < _MAX_DEPTH else "suites extend each other in a circle"
        raise ChallengeError(reason, path=path, line=line_of(tree, ["extends"]), key="extends")
    below = (
        resource_path(f"config/challenge/{STANDARD}.yaml")
        if base == STANDARD
        else path.resolve().parent / base
    )
    inherited = _read(below, depth + 1)[0]
    merged = {**inherited, **content}
    for section, merge in (("scene", overlaid), ("axes", _renamed)):
        if isinstance(content.get(section), dict):
            merged[section] = merge(inherited[section], content[section])
    return merged, tree


def _with_absolute_files(content: Any, folder: Path) -> Any:
    """Replace the names of existing files in ``folder`` by absolute paths. Returns the new content."""
    if isinstance(content, dict):
        return {key: _with_absolute_files(part, folder) for key, part in content.items()}
    if isinstance(content, list):
        return [_with_absolute_files(part, folder) for part in content]
    if isinstance(content, str) and "." in content and "\0" not in content and len(content) < 256:
        return str(folder / content) if (folder / content.split("#")[0]).is_file() else content
    return content


def _renamed(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Merge two mappings: names in ``above`` are added to ``below``, or replace them. null removes a name."""
    return {name: value for name, value in {**below, **above}.items() if value is not None}


def overlaid(scene: Mapping[str, Any], overlay: Mapping[str, Any]) -> dict[str, Any]:
    """Return a scene with some keys changed by an overlay.

    Mappings are merged, and other values replaced. In ``humans``, ``objects`` and ``cameras``, null removes a
    name. ``*`` stands for all names, after the other keys have been merged.

    Example:
        >>> overlaid({"cameras": {"a": {}, "b": {}}}, {"cameras": {"*": {"fov_deg": 9}, "b": None}})
        {'cameras': {'a': {'fov_deg': 9}}}
    """
    merged = _merged(scene, overlay)
    for section in _NAMED:
        names = overlay.get(section)
        if isinstance(names, Mapping) and isinstance(merged[section], dict):
            every = names.get("*", {})
            merged[section] = {
                name: _merged(value, every)
                for name, value in merged[section].items()
                if value is not None and name != "*"
            }
    return merged


def _merged(below: Any, above: Any) -> Any:
    if not isinstance(below, Mapping) or not isinstance(above, Mapping):
        return above
    return {**below, **{key: _merged(below.get(key), value) for key, value in above.items()}}
