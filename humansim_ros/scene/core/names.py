"""Names of nodes, humans and cameras of a scene. Humans and cameras give nodes their names."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from humansim_ros.errors import SceneError

if TYPE_CHECKING:
    from humansim_ros.scene.config.config import SceneConfig

#: Node that plays the motions of a scene.
PLAYER_NODE = "motion_player"
#: Names below ``/humans`` that ROS4HRI (REP-155) has for lists of bodies, faces and so on: a human of this
#: name would have its topics among them.
HRI_NAMES = ("bodies", "faces", "voices", "persons", "interactions", "candidate_matches")
#: Value of ``time.mode``.
LOCKSTEP = "lockstep"
#: Node that publishes the topics of the sections ``adapters`` and ``hri``.
BRIDGE_NODE = "bridge"


def skinner_node(human: str) -> str:
    """Name of the node that skins a human. The node of a camera has the name of the camera."""
    return f"skinner_{human}"


def check_node_names(
    humans: Iterable[str], cameras: Iterable[str], scanners: Iterable[str] = (), adapters: bool = False
) -> None:
    """Raise SceneError with the key if a camera or scanner has the name of another node of its scene, or a
    human a name of :data:`HRI_NAMES`.

    Args:
        humans: Names of the humans.
        cameras: Names of the cameras.
        scanners: Names of the scanners.
        adapters: Whether there is a node for adapters.
    """
    humans = list(humans)
    if taken := [name for name in humans if name in HRI_NAMES]:
        raise SceneError(
            f"/humans/{taken[0]} has topics of ROS4HRI: give the human another name, such as {taken[0]}_1",
            key=f"humans.{taken[0]}",
        )
    nodes = {
        PLAYER_NODE: "the motion player",
        **({BRIDGE_NODE: "the adapters"} if adapters else {}),
        **{skinner_node(name): f"the skinner of {name}" for name in humans},
    }
    for kind, names in (("camera", cameras), ("scanner", scanners)):
        for name in names:
            if name in nodes:
                raise SceneError(
                    f"the node of a {kind} has its name, and {name} is the node of {nodes[name]}: "
                    f"give the {kind} another name",
                    key=f"{kind}s.{name}",
                )
            nodes[name] = f"the {kind} {name}"


def variety_names(prefix: str, count: int) -> list[str]:
    """Names of the random humans of a ``variety`` or ``crowd`` section: person_1, person_2 …"""
    return [f"{prefix}_{number}" for number in range(1, count + 1)]


def human_names(config: SceneConfig) -> list[str]:
    """Names of all humans of a scene. Raises SceneError for a random human with the name of another one."""
    names = dict.fromkeys(config.humans)
    for key in ("variety", "crowd"):
        section = getattr(config, key)
        for name in () if section is None else variety_names(section.name, section.count):
            if name in names:
                raise SceneError(f"there is a human {name} already", key=f"{key}.name")
            names[name] = None
    return list(names)


def right_camera(left: str) -> str:
    """Name of the second camera of a stereo pair."""
    return left.replace("left", "right") if "left" in left else f"{left}_right"
