"""Features of scenes: what can be taken away without touching the rest. Each has a folder in scene/features.

``keys.py`` of a folder has the sections of a scene file, ``layer.py`` the layer of the pose, ``feature.py``
the :class:`Feature`. Features share what a :class:`~humansim_ros.scene.core.draft.Draft` offers. They do not
import each other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module

from humansim_ros.scene.config.config import SceneConfig
from humansim_ros.scene.core.draft import Draft
from humansim_ros.scene.core.names import human_names
from humansim_ros.scene.core.source import SceneSource

#: Features in the order in which they are called, with the condition under which a scene has them. Labels of
#: objects follow this order.
FEATURES: Mapping[str, Callable[[SceneConfig], object]] = {
    "keyframes": lambda config: any(
        item.keyframes for section in (config.humans, config.objects) for item in section.values()
    ),
    "room": lambda config: config.room,
    "variety": lambda config: config.variety,
    "crowd": lambda config: config.crowd,
    "held": lambda config: any(item.held_by for item in config.objects.values()),
    "seats": lambda config: True,
    "robot": lambda config: config.robot,
    "scanners": lambda config: config.scanners,
    "clutter": lambda config: config.randomise and config.randomise.clutter,
    "reach": lambda config: any(human.reach for human in config.humans.values()),
    "face": lambda config: any(human.face for human in config.humans.values()),
}


class Feature:
    """What a feature does while a scene is made. By default it does nothing.

    A scene calls :meth:`prepare` of all its features, then :meth:`expand` of all, then :meth:`furnish` of
    all.
    """

    def prepare(self, draft: Draft) -> None:
        """Add what humans and cameras are built with. The draft has no humans and objects yet."""

    def expand(self, draft: Draft) -> None:
        """Add humans. The humans and objects of the scene file are in the draft already."""

    def furnish(self, draft: Draft) -> None:
        """Add objects and devices, or change humans and objects. All humans are in the draft already."""


def features_of(config: SceneConfig) -> list[Feature]:
    """Features that a scene has, in the order of :data:`FEATURES`. Others are not imported."""
    names = [name for name, has in FEATURES.items() if has(config)]
    return [import_module(f"humansim_ros.scene.features.{name}.feature").FEATURE for name in names]


def begin_draft(config: SceneConfig, source: SceneSource) -> Draft:
    """Draft with the humans and objects of a scene file, without those that features add. Raises
    HumansimError, which names the key."""
    draft = Draft(config, source.loading(), human_names(config))
    for feature in features_of(config):
        feature.prepare(draft)
    for name, human in config.humans.items():
        draft.add_human(name, human)
    draft.add_objects(config.objects)
    return draft
