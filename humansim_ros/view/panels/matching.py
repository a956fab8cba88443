"""Part of the editor: shows which joint of a motion drives which bone; the user can assign joints."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from humansim_ros.errors import HumansimError, MotionError
from humansim_ros.files.reading import exists, write_file
from humansim_ros.files.yaml import parse_yaml
from humansim_ros.motion.body import Motion
from humansim_ros.motion.matching import JointMatch, JointTable, built_in_tables, match_roles, table_text
from humansim_ros.scene.core import Actor
from humansim_ros.view.edit.document import SceneDocument
from humansim_ros.view.panels.page import Page, by_user, plain_markdown

_NONE = "(none)"
#: Most joints that the list offers.
_MOST_JOINTS = 500


class MatchingTools:
    """Folder that shows how the joints of a person's motion drive the bones, and lets the user assign joints.

    Args:
        app: The page.
        document: The scene.
        edit: Function that makes an edit of the scene, and shows the result.
    """

    def __init__(self, app: Page, document: SceneDocument, edit: Callable[[Callable[[], Any]], bool]) -> None:
        self._document, self._edit = document, edit
        self._name = ""
        self._actor: Actor | None = None
        self._shown: object = None
        gui = app.gui
        self._folder = gui.add_folder("Joints of the motion", expand_by_default=False, visible=False)
        with self._folder:
            self._text = gui.add_markdown("")
            self._role = gui.add_dropdown("Role", known_roles(), hint="joint of a person, as motions name it")
            self._joint = gui.add_dropdown("Joint", (_NONE,), hint="joint of the file")
            button = gui.add_button("Assign", hint="writes a joint table beside the scene")
        self._role.on_update(lambda _: app.post(self._show_joint))
        button.on_click(by_user(app.post, lambda: self.assign(self._role.value, self._joint.value)))

    def show(self, name: str, actor: Actor | None) -> None:
        """Show the joints of a person. If ``actor`` is None, show nothing."""
        self._name, self._actor = name, actor
        self._folder.visible = actor is not None
        if actor is None or self._shown is actor.motion.match:
            return
        match, motion = actor.motion.match, actor.motion.motion
        self._shown = match
        self._text.content = match_markdown(match, motion)
        joints = (_NONE, *motion.joint_names[:_MOST_JOINTS])
        if tuple(self._joint.options) != joints:
            self._joint.options = joints
        self._show_joint()

    def assign(self, role: str, joint: str) -> None:
        """Assign a joint of the file to a role. ``(none)`` removes the joint of the role."""
        actor, name = self._actor, self._name
        if actor is None:
            return
        motion = actor.motion.motion
        stem = Path(motion.path.partition("#")[0]).stem
        path = self._document.folder / f"{''.join(c if c.isalnum() else '_' for c in stem)}_joints.yaml"

        def change() -> None:
            text = assigned(actor.motion.match, motion, role, None if joint == _NONE else joint)
            if exists(path) and self._document.value(["humans", name, "motion", "joint_names"]) != path.name:
                raise HumansimError(f"{path.name} exists already: choose it as joint_names, or remove it")
            file = str(self._document.value(["humans", name, "motion", "file"]))
            command = f"humansim motion table {shlex.quote(file)} -o {path.name}  # then edit {role}"
            with self._document.step(f"Assign {role}", command):
                self._document.write_file(path, lambda target: write_file(target, text))
                self._document.set(["humans", name, "motion", "joint_names"], path.name)

        self._shown = None
        self._edit(change)

    def _show_joint(self) -> None:
        if self._actor is None:
            return
        motion, match = self._actor.motion.motion, self._actor.motion.match
        number = match.roles.get(str(self._role.value))
        name = _NONE if number is None else motion.joint_names[number]
        if name in self._joint.options:
            self._joint.value = name


def known_roles() -> tuple[str, ...]:
    """Roles (such as ``LeftElbow``) that the built-in joint tables give to joints."""
    return tuple(dict.fromkeys(role for table in built_in_tables() for role in table.joints))


def match_markdown(match: JointMatch, motion: Motion) -> str:
    """Markdown table of the bones, with the joint that drives each bone."""
    names = [plain_markdown(name) for name in motion.joint_names]
    rows = [f"| {bone} | {names[start]} → {names[end]} |" for bone, (start, end) in match.parallel.items()]
    rows += [
        f"| {bone} | {names[joint]} (turns as it) |"
        for bone, joint in match.difference.items()
        if bone not in match.parallel
    ]
    rows += [f"| {bone} | – (stays at rest) |" for bone in match.missing]
    head = f"matched by {match.by}, table {plain_markdown(match.table)}, confidence {match.confidence:.0%}"
    reasons = "".join(f"; {plain_markdown(reason)}" for reason in match.reasons)
    return "\n".join([f"{head}{reasons}", "", "| bone | joints of the file |", "|---|---|", *rows])


def assigned(match: JointMatch, motion: Motion, role: str, joint: str | None) -> str:
    """Make the joint table of a match in which another joint has a role. If another role had that joint, the
    two roles exchange their joints.

    Args:
        match: The match.
        motion: Motion of the match.
        role: Role, such as ``LeftElbow``.
        joint: Name of a joint of the motion. If None, the role has no joint.

    Returns:
        The table as YAML.

    Raises:
        MotionError: There is no such role or joint, or the table would not drive a person.
    """
    if role not in known_roles():
        raise MotionError(f"there is no role {role[:60]!r}")
    if joint is not None and joint not in motion.joint_names:
        raise MotionError(f"the motion has no joint {joint[:60]!r}")
    data, _ = parse_yaml(table_text(match, motion), MotionError, "joint table")
    roles = dict(match.roles)
    if joint is None:
        roles.pop(role, None)
    else:
        number, before = motion.joint_names.index(joint), roles.get(role)
        other = next((key for key, its in roles.items() if its == number and key != role), None)
        if other is not None and before is not None:
            roles[other] = before  # two roles exchange their joints
        elif other is not None:
            del roles[other]
        roles[role] = number
    joints = {key: [motion.joint_names[number]] for key, number in roles.items()}
    known = {*joints, *(f"{key}_end" for key in joints)}
    kept = {
        "name": f"{str(data['name']).removesuffix(' (edited)')} (edited)",
        "joints": joints,
        "parallel": {bone: link for bone, link in data["parallel"].items() if {*link} <= known},
        "difference": {bone: other for bone, other in data["difference"].items() if other in known},
    }
    try:
        table = JointTable.model_validate(kept)
    except ValueError:
        raise MotionError(f"a person needs the role {role}: give it another joint") from None
    if not match_roles(table, roles, motion.joint_names).complete:
        raise MotionError(f"with this joint for the role {role} a limb would not move: choose another joint")
    return yaml.safe_dump(kept, sort_keys=False, allow_unicode=True)
