"""Features of scenes: what can be taken away without touching the rest. Each has a folder here.

``keys.py`` of a folder has the sections of a scene file, ``feature.py`` the :class:`Feature`. Features share
what a :class:`~humansim_ros.scene.core.draft.Draft` offers. They do not import each other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from humansim_ros.scene.config.config import SceneConfig
    from humansim_ros.scene.core.draft import Draft
    from humansim_ros.scene.core.findings import Finding, SceneSamples

#: Features in the order in which they are called, with the condition under which a scene has them.
FEATURES: Mapping[str, Callable[[SceneConfig], object]] = {
    "variety": lambda config: config.variety,
    "crowd": lambda config: config.crowd,
    "held": lambda config: any(item.held_by for item in config.objects.values()),
    "seats": lambda config: True,
    "robot": lambda config: config.robot,
    "scanners": lambda config: config.scanners,
    "clutter": lambda config: config.randomise and config.randomise.clutter,
}


class Feature:
    """What a feature does while a scene is made and checked. By default it does nothing.

    A scene calls :meth:`expand` of all its features, then :meth:`furnish` of all.
    """

    def expand(self, draft: Draft) -> None:
        """Add humans. The humans and objects of the scene file are in the draft already."""

    def furnish(self, draft: Draft) -> None:
        """Add objects and devices, or move objects. All humans are in the draft already."""

    def check(self, samples: SceneSamples) -> Iterator[Finding]:
        """Find probable mistakes in a scene that is made."""
        yield from ()


def features_of(config: SceneConfig) -> list[Feature]:
    """Features that a scene has, in the order of :data:`FEATURES`. Others are not imported."""
    modules = (
        import_module(f"{__package__}.{name}.feature") for name, has in FEATURES.items() if has(config)
    )
    return [module.FEATURE for module in modules]
