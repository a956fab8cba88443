"""Faces of the humans of a scene: from the section ``face`` of each, with gazes at others and at cameras."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import SceneError, in_section, unknown
from humansim_ros.motion.body import EYE_BONES, Eyes, within_limits
from humansim_ros.motion.files import split_motion_name
from humansim_ros.motion.pose import WITHOUT_REACH, PoseStage
from humansim_ros.people.makehuman import has_mouth, jaw_of, with_mouth
from humansim_ros.scene.config.config import LIVE, HumanConfig
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.camera import SceneCamera
from humansim_ros.scene.core.features import Draft
from humansim_ros.scene.core.findings import CheckedFeature, Finding, SceneSamples, numbers
from humansim_ros.scene.core.looks import RandomNumbers, random_numbers
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.scene.features.face import AHEAD, FaceConfig
from humansim_ros.scene.features.face.files import read_face_file
from humansim_ros.scene.features.face.layer import Face, Gaze, GazeTarget, blinks, glances, key_tracks, seen
from humansim_ros.types import Array

#: Share of the time in which eyes reach what they look at.
_SEEN = 0.5


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

    tracks = key_tracks(settings.keys, numbers)
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


class LivingFaces(CheckedFeature):
    """The key ``face`` of humans."""

    def furnish(self, draft: Draft) -> None:
        """Give humans their faces. Raises HumansimError, which names the key, as of a gaze at nobody."""
        configs, source = draft.config.humans, draft.source
        for name, config in configs.items():
            if config.face is None:
                continue
            with in_section(f"humans.{name}.face"):
                for number, key in enumerate(config.face.keys):
                    with in_section(f"keys.{number}.gaze"):
                        _check_gaze(name, key.gaze, configs, draft.cameras)
                draft.actors[name] = _with_face(draft.actors[name], config, source)

    def check(self, samples: SceneSamples) -> Iterator[Finding]:
        """Find gazes at what the eyes do not reach."""
        for name in samples.joints:
            actor, config = samples.scene.actors[name], samples.scene.config.humans[name].face
            face: Face | None = actor.settings("face")
            if face is None or config is None:
                continue
            keys = sorted(
                (key.time, number, key.gaze) for number, key in enumerate(config.keys) if key.gaze is not None
            )
            ends = [*(time for time, *_ in keys), np.inf][1:]
            for gaze, (time, number, target), end in zip(face.gazes, keys, ends, strict=True):
                times = samples.times[(samples.times >= time) & (samples.times < end)]
                if gaze.target is None or not len(times):
                    continue
                share = float(sees(actor, gaze.target, times).mean())
                if share < _SEEN:
                    shown = target if isinstance(target, str) else numbers(target)
                    head = (
                        "even with the head: "
                        if config.head
                        else "and the head does not turn with them: let it turn "
                        f"(humans.{name}.face.head: 1), "
                    )
                    text = (
                        f"the eyes of {name} reach {shown} in {share:.0%} of the time, {head}"
                        "turn the human (motion.yaw_deg), or let it look at what is before it"
                    )
                    yield Finding("warning", f"humans.{name}.face.keys.{number}.gaze", text)


def sees(actor: Actor, target: GazeTarget, times: Array) -> NDArray[np.bool_]:
    """Whether eyes and head can turn to a target at scene times (N,); always without eyes."""
    eyes = Eyes.of(actor.human.skeleton)
    if eyes is None:
        return np.ones(len(times), dtype=bool)
    joints = actor.joints_at(times, WITHOUT_REACH | {PoseStage.HEAD})
    angles = eyes.angles_to(joints, seen(actor, target, times, turned=True))
    return np.asarray((angles == within_limits(angles)).all(axis=(1, 2)))


def _with_face(actor: Actor, config: HumanConfig, source: SceneSource) -> Actor:
    """A human with its face."""
    assert config.face is not None
    human, key = actor.human, f"humans.{actor.name}.face"
    jaw = source.once(partial(jaw_of, human), "jaw", id(human.mesh.vertices))
    face = replace(face_of(actor.name, config, source), body_file=actor.motion.motion.path)
    actor = actor.with_layer("face", settings=face, jaw=jaw)
    if config.motion.file == LIVE and config.face != FaceConfig(mouth=config.face.mouth):
        source.warn(key, "another node moves this human, and its face: nothing else does")
    if config.face.mouth:
        actor = _with_mouth(actor, source)
    if human.shapes is None:
        eyes = "only its eyes move" if EYE_BONES[0] in human.skeleton.names else "nothing moves"
        source.warn(key, f"the body has no actions of the face: {eyes}")
    return actor


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


FEATURE = LivingFaces()
