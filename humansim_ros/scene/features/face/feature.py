"""Faces of the humans of a scene: from the section ``face`` of each, with gazes at others and at cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

from humansim_ros.errors import SceneError, in_section, unknown
from humansim_ros.motion.body import EYE_BONES
from humansim_ros.motion.files import split_motion_name
from humansim_ros.people.makehuman import has_mouth, jaw_of, with_mouth
from humansim_ros.scene.config.config import LIVE, FaceConfig, HumanConfig
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.camera import SceneCamera
from humansim_ros.scene.core.randomise import RandomNumbers, random_numbers
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.scene.features.face.files import read_face_file
from humansim_ros.scene.features.face.keys import AHEAD
from humansim_ros.scene.features.face.tracks import Face, Gaze, blinks, glances, key_tracks


def face_of(name: str, config: HumanConfig, source: SceneSource) -> Face:
    """Face of a human.

    Args:
        name: Name of the human: people with one seed differ.
        config: Section of the human.
        source: Finds its file.

    Raises:
        HumansimError: The file is no recording of a face; ``key`` is relative to the section ``face``.
    """
    settings = config.face or FaceConfig()

    def numbers(purpose: str) -> RandomNumbers:
        return random_numbers(settings.seed, f"face {name} {purpose}")

    tracks = key_tracks([key.key for key in settings.keys], numbers)
    gazes = sorted((key for key in settings.keys if key.gaze is not None), key=lambda key: key.time)
    looks = tuple(Gaze(key.time, None if key.gaze == AHEAD else key.gaze) for key in gazes)
    face = Face(tracks, gazes=looks, head=settings.head)
    if settings.file is not None:
        file, animation = split_motion_name(settings.file)
        with in_section("file"):
            take = read_face_file(source.find(file), animation)
        of_body = file == split_motion_name(config.motion.file)[0]
        face = replace(face, takes=(take,)) if of_body else replace(face, tracks=(*tracks, take))
    if not settings.alive:
        return face
    return replace(
        face, tracks=(*face.tracks, blinks(numbers("blinks"))), glances=glances(numbers("glances"))
    )


def with_faces(
    actors: Mapping[str, Actor],
    configs: Mapping[str, HumanConfig],
    cameras: Mapping[str, SceneCamera],
    source: SceneSource,
) -> dict[str, Actor]:
    """Humans with their faces.

    Args:
        actors: Humans by name.
        configs: Their sections.
        cameras: Cameras by name, which they may look at.
        source: Finds the files.

    Raises:
        HumansimError: With the key, as of a gaze at nobody.
    """
    faces = {name: config.face for name, config in configs.items()}
    if not any(faces.values()):
        return dict(actors)
    out = dict(actors)
    for name, config in faces.items():
        if config is None:
            continue
        with in_section(f"humans.{name}.face"):
            for number, key in enumerate(config.keys):
                with in_section(f"keys.{number}.gaze"):
                    _check_gaze(name, key.gaze, configs, cameras)
            face = face_of(name, configs[name], source)
            human = actors[name].human
            jaw = source.once(partial(jaw_of, human), "jaw", id(human.mesh.vertices))
            face = replace(face, body_file=actors[name].motion.motion.path)
            out[name] = actors[name].with_layer("face", settings=face, jaw=jaw)
            if configs[name].motion.file == LIVE and config != FaceConfig(mouth=config.mouth):
                source.warn(
                    f"humans.{name}.face", "another node moves this human, and its face: nothing else does"
                )
            if config.mouth:
                out[name] = _with_mouth(out[name], source)
            if human.shapes is None:
                eyes = "only its eyes move" if EYE_BONES[0] in human.skeleton.names else "nothing moves"
                source.warn(f"humans.{name}.face", f"the body has no actions of the face: {eyes}")
    return out


def _with_mouth(actor: Actor, source: SceneSource) -> Actor:
    """The human with teeth and tongue, in full detail at each distance."""
    human = actor.human
    if not has_mouth(human):
        source.warn(
            f"humans.{actor.name}.face.mouth",
            "the body has no teeth: the built-in humans have, and those that this version makes of sliders "
            "or draws by seed",
        )
        return actor
    shown = source.once(lambda: with_mouth(human), "mouth", id(human.mesh), human.skinning)
    return replace(actor, human=shown, levels=None)


def _check_gaze(
    name: str,
    gaze: str | tuple[float, float, float] | None,
    humans: Mapping[str, HumanConfig],
    cameras: Mapping[str, SceneCamera],
) -> None:
    if not isinstance(gaze, str) or gaze == AHEAD:
        return
    if gaze == name:
        raise SceneError("nobody can look at the own face: name another human")
    if gaze not in humans and gaze not in cameras:
        known = [*(each for each in humans if each != name), *cameras]
        raise SceneError(f"{unknown('human and no camera', gaze, known)}; {AHEAD} ends a gaze")
    if gaze in humans and humans[gaze].motion.file == LIVE:
        raise SceneError(f"another node moves {gaze}, so that its place is not known: give a point")
