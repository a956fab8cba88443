"""Recipes of data sets: a scene with distributions in place of values. Many scenes are drawn from it.

Scene i of a recipe depends only on the seed and on i, and each value has its own random numbers. So another
number of scenes, or another distribution of one value, does not change the others.
"""

from __future__ import annotations

import hashlib
import json
import os
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from humansim_ros.data.datasets.draws import DRAWS, Keys, draw_at, values_at_ends
from humansim_ros.data.datasets.recipe_config import RecipeConfig
from humansim_ros.data.datasets.scene_draws import SceneDraws, as_mapping, with_seeds
from humansim_ros.data.formats.formats import ExportFormat, chosen_formats
from humansim_ros.errors import (
    CameraError,
    ExportError,
    HumansimError,
    HumansimWarning,
    MeshError,
    MotionError,
    SceneError,
    did_you_mean,
    in_section,
    located,
)
from humansim_ros.files.reading import built_in_names
from humansim_ros.files.yaml import line_of, read_yaml, validated
from humansim_ros.motion.files import find_motion
from humansim_ros.people.keypoints import keypoint_set
from humansim_ros.people.loading import find_human
from humansim_ros.people.makehuman import PeopleConfig, is_person, person_name
from humansim_ros.scene.checks import check_scene
from humansim_ros.scene.config import (
    LIVE,
    SceneConfig,
    check_config,
    file_keys,
)
from humansim_ros.scene.core import Needs, RandomNumbers, Scene, SceneSource, Simulation, random_numbers
from humansim_ros.scene.truth import REQUIRED_CHANNELS, BodyBox

if TYPE_CHECKING:
    import yaml

#: In this number of frames of a scene, the conditions of ``require`` are checked.
_CHECKED_FRAMES = 10
#: Most people of the pool that one scene can choose from.
_MAX_BODIES = 200
#: Formats that are always written for each scene.
ALWAYS = ("images", "statistics", "huggingface")
#: Errors that drawn values can cause. After such an error, the scene is drawn again.
_DRAW_ERRORS = (SceneError, MotionError, MeshError, CameraError)


@dataclass(frozen=True)
class DrawnScene:
    """A scene of a recipe.

    Attributes:
        number: Number of the scene, from 0.
        split: Name of the split of the scene.
        attempt: Number of earlier draws of this scene that did not fulfil the recipe.
        scene: The scene.
    """

    number: int
    split: str
    attempt: int
    scene: Scene


class _Unmet(Exception):
    """Raised for a draw that does not fulfil the recipe. ``key``: key of the condition in the recipe."""

    def __init__(self, key: str, text: str) -> None:
        super().__init__(text)
        self.key = key


@dataclass(frozen=True)
class Recipe:
    """A recipe that is ready to be drawn. It can be copied to another process.

    Attributes:
        path: Absolute path of the recipe file.
        config: Content of the file.
        tree: YAML nodes of the file, for the lines in errors.
        split_of_body: Split of each body that the recipe names. Drawn people need none: their bodies are
            never the same.
    """

    path: Path
    config: RecipeConfig
    tree: yaml.Node | None
    split_of_body: Mapping[str, str]

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path, self.config, self.tree, self.split_of_body)

    @classmethod
    def load(cls, path: str | os.PathLike[str], scenes: int | None = None) -> Recipe:
        """Read a recipe, and check scenes with the smallest and largest value of each distribution.

        ``scenes``: number of scenes in place of the number in the file.

        Raises:
            ExportError: The recipe is not valid. The error names file, line and key.
        """
        content, tree = read_yaml(path, ExportError, "recipe")
        config = validated(RecipeConfig, content, ExportError, path, tree)
        if scenes is not None:
            config = config.model_copy(update={"scenes": scenes})
        recipe = cls(Path(path).resolve(), config, tree, {})
        for key, check in (
            ("formats", lambda: recipe.formats),
            ("keypoints", lambda: keypoint_set(config.keypoints)),
        ):
            try:
                check()
            except HumansimError as error:
                raise recipe.error_at(key, error.message) from None
        recipe._check_pool()
        draws = list(recipe._draws())
        recipe = cls(recipe.path, config, tree, recipe._split_bodies())
        recipe._check_ends(draws)
        return recipe

    @cached_property
    def formats(self) -> tuple[ExportFormat, ...]:
        """The formats that are written for each scene."""
        if "croissant" in self.config.formats:
            raise ExportError("croissant.json of the data set is always written: leave croissant out")
        return tuple(chosen_formats([*ALWAYS, *self.config.formats]))

    @cached_property
    def splits(self) -> tuple[str, ...]:
        """Split of each scene. The first n scenes have the shares of the recipe, for any n, up to
        rounding."""
        return tuple(_shared(self.config.splits, self.config.scenes))

    @cached_property
    def hash(self) -> str:
        """Hash of everything that determines the scenes. The number of scenes does not change the hash."""
        content = self.config.model_dump(mode="json", exclude={"about", "scenes"})
        text = json.dumps([content, self.config.about.license], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def name(self, number: int) -> str:
        """Path of the folder of a scene, relative to the folder of the data set."""
        return f"{self.splits[number]}/scene_{number:06d}"

    def draw(self, number: int) -> DrawnScene:
        """Draw a scene that fulfils the recipe.

        Raises:
            ExportError: No draw fulfils the recipe. The error names the line of the condition that failed
                most.
            RenderError: This machine cannot render.
        """
        failed: Counter[str] = Counter()
        texts: dict[str, str] = {}
        for attempt in range(self.config.attempts):
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error" if self.config.require.clean else "ignore", HumansimWarning)
                    scene = Scene.from_config(self.scene(number, attempt), self.source)
                self._check(scene)
                return DrawnScene(number, self.splits[number], attempt, scene)
            except _Unmet as unmet:
                key, text = unmet.key, str(unmet)
            except HumansimWarning as warning:
                key, text = "require.clean", str(warning)
            except _DRAW_ERRORS as error:
                key = self._key_of(error.key)
                text = str(error) if error.path else error.message
            failed[key] += 1
            texts[key] = text
        key, count = failed.most_common(1)[0]
        draws = self.config.attempts
        raise self.error_at(
            key,
            f"scene {number} ({self.splits[number]}) cannot be drawn: {count} of {draws} draws failed here, "
            f"the last one because {texts[key]}",
        )

    @property
    def source(self) -> SceneSource:
        """Source of the scene that finds the files which the recipe names."""
        return SceneSource(folder=self.path.parent)

    def scene(self, number: int, attempt: int, given: Mapping[Keys, Any] | None = None) -> SceneConfig:
        """Draw the configuration of a scene, without a check of the conditions of the recipe.

        Args:
            number: Number of the scene.
            attempt: Number of the draw.
            given: Values in place of drawn ones, by key.

        Raises:
            HumansimError: A drawn value is wrong. A SceneError names the key in the scene.
        """

        def random(keys: Keys) -> RandomNumbers:
            return random_numbers(self.config.seed, f"scene {number}.{attempt} {'.'.join(map(str, keys))}")

        draws = SceneDraws(random, lambda body: self.is_of_split(body, number), given or {})
        scene = as_mapping(draws.value(self.config.scene, ("scene",)), "")
        if self.config.ring is not None:
            cameras = as_mapping(scene.get("cameras") or {}, "cameras")
            scene["cameras"] = {**draws.ring(self.config.ring, scene), **cameras}
        self._share_pool(scene.get("variety"), number)
        for section in ("variety", "crowd"):
            self._share_bodies(scene.get(section), section, number)
        config = check_config(scene)
        self._check_fixed_bodies(config, number)
        seeded = with_seeds(config, ("scene",), draws.seed)
        assert isinstance(seeded, SceneConfig)
        return seeded

    # -- people in one split only

    def _split_bodies(self) -> dict[str, str]:
        """Split of each body that the recipe names. Raises ExportError if a split would have no body."""
        shares = {name: share for name, share in self.config.splits.items() if share > 0}
        if len(shares) == 1:
            return {}
        of: dict[str, str] = {}
        for keys, bodies in self._named_bodies():
            left = [body for _, body in sorted((_order(self.config.seed, each), each) for each in bodies)]
            left = [body for body in left if body not in of]
            missing = [name for name in shares if name not in {of.get(body) for body in bodies}]
            if len(missing) > len(left):
                raise self.error_at(
                    ".".join(map(str, keys)),
                    f"{len(shares)} splits need as many bodies, so that nobody is in two of them, and here "
                    f"are {len(bodies)}: name more, or draw people (variety.people)",
                )
            names = [*missing, *_shared(shares, len(left) - len(missing))]
            of |= dict(zip(left, names, strict=True))
        return of

    def _named_bodies(self) -> Iterator[tuple[Keys, list[str]]]:
        """Names of the bodies that can be drawn, by key of the recipe. New random people have none."""
        for section in ("variety", "crowd"):
            content = self.config.scene.get(section)
            if isinstance(content, dict) and content.get("people") is None:
                key = (*("scene", section), *(("bodies",) if "bodies" in content else ()))
                yield key, sorted(set(_texts(content.get("bodies") or built_in_names("humans"))))
        humans = self.config.scene.get("humans")
        for name, human in humans.items() if isinstance(humans, dict) else ():
            body = human.get("body", "adult_man") if isinstance(human, dict) else human
            yield ("scene", "humans", name, "body"), sorted(set(_texts(body)))

    def is_of_split(self, body: str, number: int) -> bool:
        """Whether a body may be in a scene: the body belongs to the split of the scene, or to no split."""
        return self.split_of_body.get(body, self.splits[number]) == self.splits[number]

    def _check_pool(self) -> None:
        """Check that the pool has people for each split. Raises ExportError."""
        if self.config.pool is None:
            return
        variety = self.config.scene.get("variety")
        if not isinstance(variety, dict) or "people" not in variety:
            raise self.error_at("pool", "a pool is of drawn people: give scene.variety.people, such as {}")
        given = set(_shared(self.config.splits, self.config.pool))
        if missing := [name for name, share in self.config.splits.items() if share and name not in given]:
            raise self.error_at("pool", f"nobody is left for the split {missing[0]}: give a larger pool")

    def _share_pool(self, variety: Any, number: int) -> None:
        """Replace ``people`` in ``variety`` by people of the pool that belong to the split of a scene."""
        if (
            self.config.pool is None
            or not isinstance(variety, dict)
            or not isinstance(variety.get("people"), dict)
        ):
            return
        with in_section("variety.people"):
            people = validated(PeopleConfig, variety.pop("people"), SceneError)
        splits = enumerate(_shared(self.config.splits, self.config.pool))
        numbers = [each for each, split in splits if split == self.splits[number]]
        if not numbers:
            raise self.error_at(
                "pool", f"no person is left for the split {self.splits[number]}: give more people"
            )
        shuffled = sorted(numbers, key=lambda each: _order(self.config.seed, f"{each} in scene {number}"))
        chosen = sorted(shuffled[:_MAX_BODIES])
        variety["bodies"] = [person_name(self.config.seed, each, people) for each in chosen]

    def _share_bodies(self, section: Any, name: str, number: int) -> None:
        """Remove bodies that do not belong to the split of a scene from a section called ``name``."""
        if self.split_of_body and isinstance(section, dict) and section.get("people") is None:
            bodies = section.get("bodies") or built_in_names("humans")
            kept = [body for body in bodies if self.is_of_split(body, number)]
            if not kept:
                raise SceneError(f"no body is of the split {self.splits[number]}", key=f"{name}.bodies")
            section["bodies"] = kept

    def _check_fixed_bodies(self, config: SceneConfig, number: int) -> None:
        for name, human in config.humans.items():
            if not self.is_of_split(str(human.body), number):
                raise self.error_at(
                    f"scene.humans.{name}.body",
                    f"{human.body} would be in several splits: give a choice with a body for each split",
                )

    # -- checks

    def _check_ends(self, draws: Sequence[tuple[Keys, Any]]) -> None:
        """Check the smallest and largest value of each distribution. Raises ExportError at line and key."""
        self._try({}, (), None)
        for keys, content in draws:
            for place, end, value in values_at_ends(content, keys):
                self._try({keys: value}, place, end)

    def _draws(self) -> Iterator[tuple[Keys, Any]]:
        """Distributions of the recipe, by key, without those in a choice. Raises ExportError if one is
        wrong."""
        pending: list[tuple[Keys, Any, bool]] = [(("scene",), self.config.scene, False)]
        if self.config.ring is not None:
            pending.append((("ring",), dict(self.config.ring), False))
        while pending:
            keys, value, is_inner = pending.pop()
            with located(ExportError, self.path, line_of(self.tree, keys)):
                try:
                    draw = draw_at(value)
                except ExportError as error:
                    raise error.within(".".join(map(str, keys))) from None
            if draw is not None and not is_inner:
                yield keys, value
            is_inner |= draw is not None
            if isinstance(value, dict):
                pending += [((*keys, name), part, is_inner) for name, part in value.items()]
            elif isinstance(value, (list, tuple)):
                pending += [((*keys, number), part, is_inner) for number, part in enumerate(value)]

    def _try(self, given: Mapping[Keys, Any], place: Keys, end: Any) -> None:
        """Check a scene, maybe with one value replaced; and check that its files exist.

        Args:
            given: The value that replaces a drawn one, by key. If empty, all values are drawn.
            place: Key of the distribution that has its smallest or largest value, for messages.
            end: This value.
        """
        number = 0
        if given and self.split_of_body:  # a body of another split would be an error of this one
            body = next(iter(given.values()))
            numbers = (n for n, split in enumerate(self.splits) if self.split_of_body.get(str(body)) == split)
            number = next(numbers, 0)
        try:
            config = self.scene(number, 0, given)
            for keys, name in file_keys(config):
                try:
                    self._check_file(keys, name)
                except HumansimError as error:
                    raise SceneError(error.message, key=".".join(map(str, keys))) from None
        except _DRAW_ERRORS as error:
            key = self._key_of(error.key)
            if given:
                (outer,) = given
                if _is_part(key, outer):
                    key = ".".join(map(str, place if _is_part(key, _without_options(place)) else outer))
            known = self._known(key)
            rest = key.removeprefix(known).strip(".")
            texts = (f"with {end!r}" if given else "", "" if rest.isdecimal() else rest, error.message)
            text = ": ".join(filter(None, texts)) + ("" if given else self._hint(key))
            raise self.error_at(key, text) from None

    def _check_file(self, keys: Keys, name: str) -> None:
        """Check that a body, a motion or a file exists."""
        words = [key for key in keys if isinstance(key, str)]
        folder = self.path.parent
        if words[-1] in ("body", "bodies"):
            find_human(name, folder, SceneError)
        elif words[-1] == "motions" or words[-2:] == ["motion", "file"]:
            if name != LIVE:
                find_motion(name, folder, SceneError)
        elif Path(name).suffix and "://" not in name and "{name}" not in name:
            self.source.find(name.split("#")[0])

    def _hint(self, key: str) -> str:
        """Advice for the end of an error message, if the mapping at a key may be meant as a distribution."""
        value: Any = self.config.model_dump()
        for word in key.split("."):
            value = value.get(word) if isinstance(value, dict) else None
        words = list(value) if isinstance(value, dict) else []
        return did_you_mean(str(words[0]), DRAWS) if len(words) == 1 and words[0] not in DRAWS else ""

    def _check(self, scene: Scene) -> None:
        """Check the conditions of the recipe for a scene. Raises _Unmet, which names the condition."""
        require = self.config.require
        if require.clean and (findings := check_scene(scene, quick=True)):
            raise _Unmet("require.clean", str(findings[0]))
        bodies = [str(human.body) for human in scene.config.humans.values()]
        if twins := [body for body, count in Counter(filter(is_person, bodies)).items() if count > 1]:
            raise _Unmet("pool", f"{twins[0]} is there twice: give a larger pool, or fewer people")
        if not require.cameras:
            return
        # cheap, before anything is rendered
        heights = [camera.size[1] for camera in scene.cameras.values()]
        if len(heights) < require.cameras:
            raise _Unmet("require.cameras", f"it has {len(heights)} cameras, not {require.cameras}")
        if (high := sum(height >= require.pixels for height in heights)) < require.cameras:
            text = f"{high} of its {len(heights)} images are {require.pixels:g} pixels high"
            raise _Unmet("require.pixels", text)
        last = self.config.frames - 1
        frames = np.unique(np.linspace(0, last, min(last + 1, _CHECKED_FRAMES)).round().astype(int))
        needs = Needs(REQUIRED_CHANNELS["boxes"])
        with closing(Simulation(scene)) as simulation:
            for index in frames.tolist():
                truth = simulation.frame(index, needs).truth
                for name in scene.actors:
                    self._check_person(name, index, [each.boxes[name] for each in truth.values()])

    def _check_person(self, name: str, index: int, boxes: Sequence[BodyBox]) -> None:
        require = self.config.require
        inside = [box for box in boxes if box.pixels]
        large = [box for box in inside if box.visible[3] - box.visible[1] >= require.pixels]
        seen = [box for box in large if box.visible_fraction >= require.visible]
        if len(seen) >= require.cameras:
            return
        many = [box for box in inside if box.visible_fraction >= require.visible]
        key = "pixels" if len(many) >= require.cameras else "visible"
        if max(len(large), len(many)) < require.cameras:
            key = "cameras"
        raise _Unmet(
            f"require.{key}",
            f"{len(seen)} of the {len(boxes)} cameras see {name} in frame {index}, not {require.cameras}",
        )

    def _key_of(self, key: str | None) -> str:
        """Key of the recipe that a key of a drawn scene comes from."""
        words = (key or "").split(".")
        given = self.config.scene.get("cameras")
        named = given if isinstance(given, dict) else {}
        if self.config.ring is not None and words[0] == "cameras" and words[1:] and words[1] not in named:
            of = (
                part for part in ("each", "camera") if set(words[2:3]) & set(getattr(self.config.ring, part))
            )
            words = ["ring", *(f"{part}.{words[2]}" for part in of)][:2]
        if words[0] == "ring":
            return ".".join(words)
        return ".".join(["scene", *filter(None, words)])

    def error_at(self, key: str, message: str) -> ExportError:
        """Return an error that names a key of the recipe, or the nearest key above that the file has."""
        line = line_of(self.tree, key.split("."))
        return ExportError(message, path=self.path, line=line, key=self._known(key) or None)

    def _known(self, key: str) -> str:
        """The part of a key that exists in the file, such as ``scene.humans`` of ``scene.humans.anna``."""
        content: Any = self.config.model_dump()
        known: list[str] = []
        for word in key.split("."):
            if isinstance(content, dict) and word in content:
                content = content[word]
            elif isinstance(content, (list, tuple)) and word.isdecimal() and int(word) < len(content):
                content = content[int(word)]
            else:
                break
            known.append(word)
        return ".".join(known)


def _shared(shares: Mapping[str, float], count: int) -> Iterator[str]:
    """Yield names in proportion to their shares. The name that lacks most of its share is next."""
    whole = sum(shares.values())
    given = dict.fromkeys(shares, 0)
    for number in range(1, count + 1):
        name = max(shares, key=lambda name: shares[name] / whole * number - given[name])
        given[name] += 1
        yield name


def _order(seed: int, body: str) -> float:
    return random_numbers(seed, f"split of {body}")()


def _texts(value: Any) -> Iterator[str]:
    """All texts in a value, including those among the values of a choice."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for part in value.get("choice", ()):
            yield from _texts(part)
    elif isinstance(value, (list, tuple)):
        for part in value:
            yield from _texts(part)


def _is_part(key: str, keys: Keys) -> bool:
    """Whether two paths of keys are equal, or one is the beginning of the other."""
    words, others = key.split("."), [str(part) for part in keys]
    least = min(len(words), len(others))
    return words[:least] == others[:least]


def _without_options(keys: Keys) -> Keys:
    """Remove ``choice`` and option number from a key of a recipe, to get the key in a drawn scene."""
    words = list(keys)
    while "choice" in words:
        at = words.index("choice")
        del words[at : at + 2]
    return tuple(words)
