"""A person who is made from a mesh in steps: mesh, skeleton, weights, files next to the scene."""

from __future__ import annotations

import shlex
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from humansim_ros.errors import HumansimError, HumansimWarning, MeshError
from humansim_ros.files.mesh import Mesh, SkinnedMesh, read_mesh_or_figure
from humansim_ros.files.reading import exists, write_file
from humansim_ros.files.yaml import schema_errors
from humansim_ros.motion.body import Skeleton, side_of
from humansim_ros.people.humans import Human, write_human
from humansim_ros.people.loading import MeshHuman, fit_mesh, load_human, make_human
from humansim_ros.people.rigging import joints_of, skeleton_at
from humansim_ros.scene.pictures import bone_colors
from humansim_ros.types import Array, Image
from humansim_ros.view.edit.scene_keys import find_key
from humansim_ros.view.edit.yaml_edit import flow
from humansim_ros.view.server.server import inside

#: Largest number of steps that can be undone.
_MOST_STEPS = 200
#: First line of descriptions that the page writes. The page overwrites only descriptions with this line.
_HEAD = "# Written by the tab Human of `humansim view`.\n"
#: Colours of vertices with weight 0 and with weight 1.
_COLD, _WARM = np.array([225.0, 225.0, 225.0]), np.array([214.0, 40.0, 30.0])


@dataclass(frozen=True)
class PersonDraft:
    """An unfinished person. Drafts are immutable: each step returns a new draft.

    Attributes:
        folder: Folder of the scene.
        settings: Description of the person (docs/humans.md); names the mesh file in ``folder``.
        mesh: The mesh in body space; if ``figure``, in the space of its file.
        skeleton: Skeleton of the person, with all joints that the user has moved.
        human: The person with skinning weights; None before the weights are computed.
        figure: Whether the file has a skeleton and weights of its own, which are kept.
        warnings: Texts of the warnings from reading the file.
        before: For undo: the moved joints before each of the last steps.
    """

    folder: Path
    settings: MeshHuman
    mesh: Mesh
    skeleton: Skeleton
    human: Human | None = None
    figure: bool = False
    warnings: tuple[str, ...] = ()
    before: tuple[Mapping[str, Any], ...] = field(default=(), repr=False)

    @classmethod
    def of(cls, folder: Path, options: Mapping[str, Any]) -> PersonDraft:
        """Read a mesh, and fit a skeleton to it. A file with a skeleton and weights of its own keeps these.

        Args:
            folder: Folder of the scene.
            options: Keys of a description (docs/humans.md); ``mesh`` is a file in ``folder``.

        Raises:
            HumansimError: A value is wrong, the file cannot be read, or the mesh is no standing person.
        """
        try:
            settings = MeshHuman.model_validate(dict(options))
        except ValidationError as reason:
            raise schema_errors(reason, MeshHuman, MeshError)[0] from None
        path = inside(folder, settings.mesh)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            draft = cls._read(folder, path, settings)
        told = tuple(str(one.message) for one in caught if issubclass(one.category, HumansimWarning))
        return replace(draft, warnings=told)

    @classmethod
    def _read(cls, folder: Path, path: Path, settings: MeshHuman) -> PersonDraft:
        source: Mesh | SkinnedMesh | None = None
        if path.suffix.lower() != ".npz":
            source = read_mesh_or_figure(path)
        if source is None or isinstance(source, SkinnedMesh):
            human = make_human(path, settings)
            return cls(folder, settings, human.mesh, human.skeleton, human, figure=True)
        mesh, skeleton = fit_mesh(source, settings)
        return cls(folder, settings, mesh, skeleton)

    @property
    def joints(self) -> dict[str, Array]:
        """Positions (3,) in body space of the joints that can be moved, metres, by name; empty for a
        figure."""
        return {} if self.figure else joints_of(self.skeleton)

    @property
    def stature(self) -> float:
        """Height of the mesh, metres."""
        return float(np.ptp(self.mesh.vertices[:, 1]))

    def moved(self, joint: str, place: Array, both: bool = True, *, keep: bool = True) -> PersonDraft:
        """Return a draft in which a joint has another place.

        Args:
            joint: Name of the joint.
            place: (3,) in body space, metres.
            both: Whether to mirror the change to the other side, and put a central joint in the middle.
            keep: Whether :meth:`undone` can undo this step.

        Raises:
            MeshError: There is no such joint, or the place is too far from the person.
        """
        joints = self.joints
        if joint not in joints:
            raise MeshError(
                "a figure has its own joints, which stay" if self.figure else f"no joint {joint!r}"
            )
        given = np.asarray(place, dtype=float)
        if given.shape != (3,) or not np.isfinite(given).all() or np.abs(given).max() > 2 * self.stature:
            raise MeshError("a joint is a point at the person: three numbers in metres")
        side = side_of(joint)
        changed = {joint: given}
        if both and side:
            other = f"{'r' if joint[0] == 'l' else 'l'}{joint[1:]}"
            changed[other] = given * [-1, 1, 1]
        elif both:
            changed[joint] = given * [0, 1, 1]
        placed = dict(self.settings.joints) | {
            name: tuple(np.round(point, 4).tolist()) for name, point in changed.items()
        }
        return self._placed(placed, keep)

    def undone(self) -> PersonDraft:
        """The draft before the last move of a joint; the same draft if no joint was moved."""
        if not self.before:
            return self
        draft = self._placed(dict(self.before[-1]), keep=False)
        return replace(draft, before=self.before[:-1])

    def detected(self) -> PersonDraft:
        """The draft with all joints as detected, by a new fit of the skeleton. Raises MeshError if that
        fails."""
        options = {**self.options, "joints": {}}
        return replace(PersonDraft.of(self.folder, options), before=(*self.before, self.settings.joints))

    def _placed(self, placed: dict[str, Any], keep: bool) -> PersonDraft:
        missing = self.settings.joints.keys() - placed.keys()
        if missing:  # back to where they were detected
            mesh, skeleton = fit_mesh(
                _mesh(inside(self.folder, self.settings.mesh)),
                self.settings.model_copy(update={"joints": placed}),
            )
        else:
            joints = self.joints | {name: np.array(point) for name, point in placed.items()}
            mesh, skeleton = self.mesh, skeleton_at(joints)
        settings = self.settings.model_copy(update={"joints": placed})
        before = (*self.before, self.settings.joints)[-_MOST_STEPS:] if keep else self.before
        return replace(self, settings=settings, mesh=mesh, skeleton=skeleton, human=None, before=before)

    def rigged(self, **changes: Any) -> PersonDraft:
        """The draft with skinning weights, computed as ``humansim human build`` does.

        ``changes``: keys of the description that change, such as ``rigging`` and ``outfits``.

        Raises:
            MeshError: The mesh cannot be rigged, or a value is wrong.
        """
        try:
            settings = MeshHuman.model_validate({**self.options, **changes})
        except ValidationError as reason:
            raise schema_errors(reason, MeshHuman, MeshError)[0] from None
        path = inside(self.folder, settings.mesh)
        found = {
            name: str(inside(self.folder, one.texture))
            for name, one in settings.outfits.items()
            if one.texture
        }
        outfits = {
            name: one.model_copy(update={"texture": found.get(name)})
            for name, one in settings.outfits.items()
        }
        human = make_human(path, settings.model_copy(update={"outfits": outfits}))
        return replace(self, settings=settings, mesh=human.mesh, skeleton=human.skeleton, human=human)

    @property
    def options(self) -> dict[str, Any]:
        """Keys of the description that differ from their defaults."""
        return self.settings.model_dump(exclude_defaults=True, mode="json")

    def text(self) -> str:
        """Text of the description, as the file has it."""
        return _HEAD + "".join(f"{key}: {flow(value)}\n" for key, value in self.options.items())

    def command(self, name: str) -> str:
        """The command that makes the same person without the page."""
        return f"humansim human build {shlex.quote(name)}.yaml -o {shlex.quote(name)}.npz"

    def write(self, name: str) -> str:
        """Write the description and the person, ``name.yaml`` and ``name.npz``, next to the scene.

        The files equal those that :meth:`command` makes.

        Returns:
            Name of the human file.

        Raises:
            HumansimError: The person has no weights; the name is wrong; or foreign files have this name.
        """
        if self.human is None:
            raise MeshError("compute the weights first")
        find_key(["humans", name])  # checks the name
        description = inside(self.folder, f"{name}.yaml")
        person = inside(self.folder, f"{name}.npz")
        own = exists(description) and _is_own(description)
        for path in (description, person):
            if exists(path) and not own:
                raise HumansimError(
                    f"{path.name} exists already, and is not of this tab: choose another name"
                )
        write_file(description, self.text())
        write_human(person, load_human(description))  # as the command does
        return person.name

    # --- what is drawn

    def segments(self) -> tuple[Array, Image]:
        """Bones as lines (B, 2, 3) in body space, and the colours (B, 2, 3) of their ends: left blue, right
        red."""
        lines = np.stack([self.skeleton.heads, self.skeleton.tails], axis=1)
        palette = {0: (70, 70, 70), 1: (40, 90, 210), -1: (210, 50, 40)}
        colors = np.array([[palette[side_of(name)]] * 2 for name in self.skeleton.names], np.uint8)
        return lines, colors

    def weight_colors(self, bone: str | None = None) -> Image:
        """Colours (V, 3) of the vertices that show their weights.

        ``bone``: show the weight of this bone, grey (0) to red (1). If None, mix the colours of all bones.

        Raises:
            MeshError: The person has no weights, or there is no such bone.
        """
        if self.human is None:
            raise MeshError("compute the weights first")
        weights = self.human.weights
        if bone is None:
            mixed = weights @ bone_colors(weights.shape[1])
        else:
            share = weights[:, self.human.skeleton.bone(bone)].toarray()
            mixed = _COLD + share * (_WARM - _COLD)
        return np.asarray(np.clip(np.rint(mixed), 0, 255), dtype=np.uint8)


def _mesh(path: Path) -> Mesh:
    source = read_mesh_or_figure(path)
    assert isinstance(source, Mesh)
    return source


def _is_own(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(len(_HEAD)) == _HEAD.encode()
    except OSError:
        return False
