"""The furnished room."""

from __future__ import annotations

from functools import lru_cache, partial

from humansim_ros.files.mesh import Mesh
from humansim_ros.scene.core.draft import Draft
from humansim_ros.scene.core.environment import Furnishing
from humansim_ros.scene.core.features import Feature
from humansim_ros.scene.features.room.meshes import fixtures, furnished_room


class Room(Feature):
    """The section ``room``."""

    def prepare(self, draft: Draft) -> None:
        """Add the room and its furniture."""
        room = draft.config.room
        assert room is not None
        draft.furnishing = Furnishing(fixtures(room.size[:2]), partial(_furnished, room.size, room.seed))


@lru_cache(maxsize=2)
def _furnished(size: tuple[float, float, float], seed: int) -> tuple[Mesh, ...]:
    """Meshes of a room; kept, because an editor makes a scene again after each edit."""
    return tuple(furnished_room(size, seed))


FEATURE = Room()
