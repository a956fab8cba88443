"""Datasheet of a data set [Gebru 2021]: one HTML page, and the README of Hugging Face with the same answers.

Gebru et al., Datasheets for datasets, Communications of the ACM 64(12), 2021, ask about motivation,
composition, collection, processing, uses, distribution and maintenance. The pages keep this order. All
questions about living people get one answer, since the people are simulated.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from humansim_ros.data.datasets.recipe_config import RecipeConfig
from humansim_ros.data.formats.croissant import card_header
from humansim_ros.data.formats.markup import Markup, page, picture
from humansim_ros.data.formats.statistics import ANGLES, HISTOGRAMS, Histogram, Totals
from humansim_ros.data.formats.writer import LICENSES, frame_name
from humansim_ros.errors import ExportError
from humansim_ros.files.reading import ANY_SIZE, read_bytes
from humansim_ros.people.makehuman import MONK_TONES

#: Address of the paper by Gebru et al.
_PAPER = "https://doi.org/10.1145/3458723"
#: Width, height and margins (sides, top, bottom) of a plot, pixels.
_WIDTH, _HEIGHT, _MARGIN, _TOP, _BOTTOM = 330, 170, 12, 30, 34
#: Number of example images, and their width in pixels.
_EXAMPLES, _EXAMPLE_WIDTH = 8, 264
#: Histograms of the traits of people that are numbers.
_TRAITS = {
    "age": Histogram("Age", "years", "people", 0, 10, 9),
    "stature": Histogram("Stature", "m", "people", 0.6, 0.1, 17),
}
#: Most rows in a chart of words.
_MOST_ROWS = 10


@dataclass(frozen=True)
class DataSetSummary:
    """Facts about a data set that its pages show.

    Attributes:
        config: Content of the recipe.
        totals: Statistics of all scenes.
        parts: Statistics by split.
        own_licenses: Licences of the data set, as the recipe or its scenes state them.
        licenses: Licences of the human bodies.
        versions: Versions of programs, and the device that rendered.
        examples: Paths of example images.
        suffix: Suffix of the image files.
    """

    config: RecipeConfig
    totals: Totals
    parts: Mapping[str, Totals]
    own_licenses: Sequence[str]
    licenses: Sequence[str]
    versions: Mapping[str, str]
    examples: Sequence[Path]
    suffix: str = ".png"

    @property
    def title(self) -> str:
        """Title of the data set."""
        return self.config.about.title or self.config.recipe

    @property
    def made(self) -> str:
        """One sentence on what the data set has, and how it was made."""
        totals = self.totals
        return (
            f"{totals.images} synthetic images with ground truth of {len(totals.people)} people in "
            f"{totals.scenes} scenes, drawn from a recipe by humansim_ros {self.versions['humansim_ros']}."
        )

    @cached_property
    def license_links(self) -> dict[str, str]:
        """Address of each licence text, by licence: those of the data set, then those of the bodies."""
        names = dict.fromkeys([*self.own_licenses, *self.licenses])
        return {name: LICENSES.get(name, name) for name in names}

    @cached_property
    def card(self) -> dict[str, Any]:
        """Properties of the data set for the header of a data card."""
        return card_header(self.config.about, self.config.recipe, self.made, self.license_links)


# -- answers, for both pages


#: Sentence for all data sets.
_TRUTH = "The truth is computed; images have the noise of the sensors."
_PURPOSE = "Training and tests of detectors, trackers, and pose estimators with one or many cameras."
_LIMITS = """People are rendered: skin, cloth and light are simpler than in photographs, so test on real
images as well. Statures and weights of drawn people follow a survey of the United States; skin tones, hair
and clothes are spread without a source. Motions are a small number of recordings and built activities."""


def _answers(summary: DataSetSummary) -> dict[str, dict[str, str]]:
    """Answers to the questions of the datasheet, by section and question."""
    config, totals, about = summary.config, summary.totals, summary.config.about
    unknown, require, missing = "The recipe does not say.", config.require, config.scenes - totals.scenes
    drawn = sum("age" in person for person in totals.people.values())
    files = f"; in further files {', '.join(config.formats)}" if config.formats else ""
    wanted = []
    if require.cameras:
        wanted = [f"at least {require.cameras} cameras see {100 * require.visible:g} % of each person"]
        wanted[0] += f", {require.pixels:g} pixels high" if require.pixels else ""
    wanted += ["scenes have no finding of humansim check"] if require.clean else []
    made_with = ", ".join(f"{name} {value}" for name, value in summary.versions.items())
    links = [name if name == url else f"{name} ({url})" for name, url in summary.license_links.items()]
    return {
        "Motivation": {
            "For what purpose was it made?": about.description or unknown,
            "Who made it?": ", ".join(about.creators) or unknown,
        },
        "Composition": {
            "What do the instances represent?": f"Images of virtual people: {config.frames} frames of each "
            f"of {totals.scenes} scenes, from all cameras.",
            "What does each instance have?": "A colour image, the calibration and pose of its camera, and of "
            f"each visible person box, visible share and the keypoints {config.keypoints}{files}.",
            "Is anything missing?": f"{missing} of {config.scenes} scenes could not be drawn."
            if missing
            else "No.",
            "Are there splits?": f"{', '.join(config.splits)}: no scene and no body is in two of them."
            if len(config.splits) > 1
            else "No.",
            "Does it identify people?": f"Nobody is real. {drawn} of {len(totals.people)} people are drawn "
            "by seed; statistics.json of a scene has their age, sex, stature and skin tone.",
            "Are there errors or noise?": _TRUTH,
        },
        "Collection": {
            "How was it made?": f"Drawn from the recipe {config.recipe} with seed {config.seed}, and "
            f"rendered. Versions: {made_with}. The same recipe and versions give the same files.",
            "How were scenes chosen?": f"So that {' and '.join(wanted)}. Others were drawn anew, which "
            "shifts the distributions of the recipe."
            if wanted
            else "As drawn, without a choice.",
        },
        "Uses and limits": {
            "What is it for?": _PURPOSE,
            "What must be kept in mind?": " ".join(_LIMITS.split()),
        },
        "Distribution and maintenance": {
            "Under which licence?": ", ".join(links) or "The recipe states none.",
            "How is it cited?": summary.card["citeAs"],
            "Which version is this?": f"{about.version}{f', {about.date}' if about.date else ''}. A new "
            "version has a new number; SHA256SUMS has the hash of each file.",
            **({"Where is it?": about.url} if about.url else {}),
        },
    }


def _split_rows(summary: DataSetSummary) -> list[list[str]]:
    return [
        [name, *(f"{number:,}" for number in (part.scenes, part.images, len(part.people)))]
        for name, part in summary.parts.items()
    ]


_SPLIT_HEADER = ("split", "scenes", "images", "people")


# -- the HTML page


def datasheet(summary: DataSetSummary) -> str:
    """Datasheet as one HTML page, which loads no other files."""
    totals, about = summary.totals, summary.config.about
    tiles = {
        "scenes": totals.scenes,
        "images": totals.images,
        "people": len(totals.people),
        "cameras": sum(totals.histograms["fov"].values()),
        "boxes": sum(totals.histograms["visible"].values()),
        "poses": sum(totals.histograms["knee.flexion"].values()) // 2,
    }
    facts = [about.version, about.date, ", ".join(about.creators), ", ".join(summary.own_licenses)]
    return page(
        "datasheet",
        title=summary.title,
        facts=" · ".join(filter(None, ["Datasheet", *facts])),
        tiles=tiles,
        examples=list(_examples(summary.examples)),
        answers=_answers(summary),
        split_header=_SPLIT_HEADER,
        splits=_split_rows(summary),
        plots=list(_plots(summary)),
        paper=_PAPER,
        width=_WIDTH,
        height=_HEIGHT,
        margin=_MARGIN,
        bottom=_HEIGHT - _BOTTOM,
        ink="#1d2433",
        pale="#6b7385",
        bar="#2f6fab",
        line="#dfe3ea",
    )


def _examples(paths: Iterable[Path]) -> Iterator[Markup]:
    for path in paths:
        encoded = np.frombuffer(read_bytes(path, ExportError, "image", ANY_SIZE), np.uint8)
        image = cv2.imdecode(encoded, cv2.IMREAD_COLOR) if encoded.size else None
        if image is not None:
            height = round(image.shape[0] * _EXAMPLE_WIDTH / image.shape[1])
            small = cv2.resize(image, (_EXAMPLE_WIDTH, height), interpolation=cv2.INTER_AREA)
            yield picture(
                small[..., ::-1].astype(np.uint8), f"{path.parent.parent.parent.name} {path.parent.name}"
            )


def example_paths(root: Path, scenes: Mapping[str, Sequence[str]], frames: int, suffix: str) -> list[Path]:
    """Paths of example images, taken at even distances from all scenes, cameras and frames.

    Args:
        root: Folder of the data set.
        scenes: Names of the cameras, by folder of the scene.
        frames: Number of frames of each scene.
        suffix: Suffix of the image files.
    """
    names = list(scenes)
    count = max(_EXAMPLES, len(names)) if names else 0
    chosen = [(k * max(len(names), 1)) // min(count, _EXAMPLES) for k in range(min(count, _EXAMPLES))]
    paths = []
    for number, index in enumerate(chosen):
        name = names[index % len(names)]
        cameras = scenes[name]
        frame = frame_name((number * frames) // _EXAMPLES)
        paths.append(root / name / "images" / cameras[number % len(cameras)] / f"{frame}{suffix}")
    return paths


#: A plot: its kind, which is a macro of the template, and what the macro draws.
_Plot = dict[str, Any]


def _plots(summary: DataSetSummary) -> Iterator[tuple[str, list[_Plot]]]:
    totals, people = summary.totals, list(summary.totals.people.values())
    traits = [
        _columns(row, row.count(person[key] for person in people if key in person), (0, row.bins))
        for key, row in _TRAITS.items()
    ]
    yield (
        "People",
        [
            *traits,
            _bars("Sex", Counter(person.get("sex", "not known") for person in people)),
            _skin(Counter(person["skin"] for person in people if "skin" in person)),
            _bars("Clothes", Counter(word for person in people for word in person.get("clothes", ()))),
        ],
    )
    yield "Poses", [_bars("Motion", totals.motions), _ranges(totals)]
    for title, names in (
        ("Cameras", ("cameras", "camera_height", "fov", "distance", "elevation", "heading")),
        ("Visibility", ("people", "visible", "truncation", "height")),
        ("Light", ("brightness", "sun")),
    ):
        plots = [_histogram(name, totals) for name in names]
        if title == "Cameras":
            plots += [_bars("Image size", totals.sizes), _bars("Lens", totals.lenses)]
        yield title, plots


def _histogram(name: str, totals: Totals) -> _Plot:
    """Histogram of a quantity, from its first to its last bin with values."""
    row, counts = HISTOGRAMS[name], totals.histograms[name]
    used = sorted(number for number, count in counts.items() if count)
    span = (used[0], used[-1] + 1) if used else (0, 1)
    return _columns(row, counts, span)


def _columns(row: Histogram, counts: Mapping[int, int], span: tuple[int, int]) -> _Plot:
    """Columns of a histogram for the bins from ``span[0]`` up to, but not including, ``span[1]``."""
    first, last = span
    most = max((counts.get(number, 0) for number in range(*span)), default=0) or 1
    step = (_WIDTH - 2 * _MARGIN) / (last - first)
    columns = []
    for number in (each for each in range(first, last) if counts.get(each)):
        height = max(1.0, (_HEIGHT - _BOTTOM - _TOP) * counts[number] / most)
        ends = f"{row.edge(number):.4g} to {row.edge(number + 1):.4g} {row.unit}"
        x = _MARGIN + step * (number - first) + 0.5
        columns.append((x, height, max(step - 1, 1.0), f"{ends}: {counts[number]:,}"))
    is_count = row.width == 1 and not row.unit
    ticks = [
        (_MARGIN + step * (number - first + 0.5 * is_count), f"{row.edge(number):.4g}")
        for number in range(first, last + (not is_count), max(1, -(-(last - first) // 6)))
    ]
    note = _note(counts, most, row.of, row.unit)
    return {"kind": "columns", "title": row.title, "columns": columns, "ticks": ticks, "note": note}


def _note(counts: Mapping[int, int], most: int, of: str, unit: str = "") -> str:
    """Text below a plot with columns: unit, total number, and number in the highest column."""
    total = sum(counts.values())
    if not total:
        return "no data"
    return f"{f'{unit}, ' if unit else ''}{total:,} {of}, {most:,} in the highest column"


def _bars(title: str, counts: Mapping[str, int]) -> _Plot:
    """Chart with a bar for each of the most frequent words. ``counts``: number by word."""
    rows = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    if len(rows) > _MOST_ROWS + 1:
        left = sum(count for _, count in rows[_MOST_ROWS:])
        rows = [*rows[:_MOST_ROWS], (f"{len(rows) - _MOST_ROWS} others", left)]
    most = max((count for _, count in rows), default=0) or 1
    bars = [(name[:22], (_WIDTH - 190) * count / most, f"{count:,}") for name, count in rows]
    return {"kind": "bars", "title": title, "rows": bars}


def _skin(counts: Mapping[int, int]) -> _Plot:
    """Chart of the number of people by skin tone of the Monk scale, in the colours of the scale."""
    most, step = max(counts.values(), default=0) or 1, (_WIDTH - 2 * _MARGIN) / len(MONK_TONES)
    highest = _HEIGHT - _BOTTOM - 6 - _TOP
    columns = [
        (_MARGIN + step * number, highest * counts.get(number + 1, 0) / most, step, f"rgb({r},{g},{b})")
        for number, (r, g, b) in enumerate(MONK_TONES)
    ]
    note = _note(counts, most, "people")
    return {"kind": "scale", "title": "Skin tone, Monk scale", "columns": columns, "note": note}


def _ranges(totals: Totals) -> _Plot:
    """Chart of the angles of each joint: a bar from the 5th to the 95th percentile, and the median."""
    width, left, right, low, high = 2 * _WIDTH + 24, 140, 90, -90, 180
    scale = (width - left - right) / (high - low)
    rows = []
    for name in (each for each in ANGLES if totals.histograms[each]):
        values = (totals.quantile(name, share) for share in (0.05, 0.5, 0.95))
        first, middle, last = (float(np.clip(value, low, high)) for value in values)
        places = [left + scale * (value - low) for value in (first, middle)]
        length = max(scale * (last - first), 1.0)
        rows.append((ANGLES[name], places[0], length, places[1], f"{first:.0f}° to {last:.0f}°"))
    ticks = [(left + scale * (angle - low), f"{angle}°") for angle in range(low, high + 1, 30)]
    title = "Joint angles: 5th to 95th percentile, and median"
    return {"kind": "ranges", "title": title, "rows": rows, "ticks": ticks}


# -- the page of Hugging Face


def readme(summary: DataSetSummary) -> str:
    """Text of README.md. Its header has splits, licence and sizes for the Python package ``datasets``."""
    text = [f"---\n{yaml.safe_dump(_front_matter(summary), sort_keys=False, allow_unicode=True)}---"]
    text += [f"# {summary.title}", summary.card["description"]]
    rows = [_SPLIT_HEADER, ("---",) * len(_SPLIT_HEADER), *_split_rows(summary)]
    text.append("\n".join(f"| {' | '.join(row)} |" for row in rows))
    text.append(
        "```python\nfrom datasets import load_dataset\n\n"
        'images = load_dataset("FOLDER", split="' + next(iter(summary.parts)) + '")\n'
        'images[0]["image"], images[0]["objects"]["bbox"]\n```'
    )
    text.append(
        "`datasheet.html` has the distributions of people, poses, cameras, light and visibility. Each folder "
        "`SPLIT/SCENE` has the scene (`scene.yaml`, opened by `humansim view`), `calibration.yaml`, "
        "`metadata.jsonl` and its images"
        + (f", and {', '.join(summary.config.formats)}" if summary.config.formats else "")
        + ". `sha256sum -c --quiet SHA256SUMS` checks all files."
    )
    for title, answers in _answers(summary).items():
        text.append(f"## {title}")
        text += [f"**{question}** {answer}" for question, answer in answers.items()]
    return "\n\n".join(text) + "\n"


#: Size classes of Hugging Face; a class has fewer images than its number.
_SIZES = {"n<1K": 1e3, "1K<n<10K": 1e4, "10K<n<100K": 1e5, "100K<n<1M": 1e6, "1M<n<10M": 1e7}


def _front_matter(summary: DataSetSummary) -> dict[str, Any]:
    own, images = summary.own_licenses, summary.totals.images
    if all(name in LICENSES for name in own):
        identifiers = [name.lower() for name in own]
        stated = {"license": identifiers[0] if len(own) == 1 else identifiers} if own else {}
    else:
        stated = {"license": "other", "license_name": ", ".join(own)}
    return {
        "pretty_name": summary.title,
        **stated,
        "task_categories": ["object-detection", "keypoint-detection"],
        "size_categories": [next((name for name, most in _SIZES.items() if images < most), "10M<n<100M")],
        "tags": ["synthetic", "human-pose-estimation", "croissant", "humansim_ros"],
        "configs": [
            {
                "config_name": "default",
                "data_files": [
                    {
                        "split": name,
                        "path": [f"{name}/*/metadata.jsonl", f"{name}/*/images/*/*{summary.suffix}"],
                    }
                    for name, part in summary.parts.items()
                    if part.images
                ],
            }
        ],
    }
