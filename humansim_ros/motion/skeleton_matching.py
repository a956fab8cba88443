"""A person found in a skeleton by its shape: tree, link lengths and symmetry, whatever the joints are called.

Lengths along the tree are used, which no pose changes: two equal legs on one joint, two equal arms on
another, and a head beside the arms. Only left and right need a pose, if no name tells them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from humansim_ros.motion.joint_match import JointMatch, match_roles
from humansim_ros.motion.joint_tables import JointTable
from humansim_ros.motion.kinematics import Motion
from humansim_ros.rotations import unit_vectors
from humansim_ros.types import Array

#: Two branches are a pair if their lengths differ by no more than this share.
_ALIKE = 0.12
#: Shares of a leg (thigh, shin, foot) and an arm (upper arm, forearm, hand) of a typical person.
_LEG, _ARM = np.array([0.43, 0.41, 0.16]), np.array([0.42, 0.36, 0.22])
#: An arm by the length of a leg, and what is above the arms' joint, likewise.
_ARM_BY_LEG, _HEAD_BY_LEG = 0.72, 0.28
#: How much the length of a bone may vary, as a share of it.
_STIFF = 0.01
#: Less than this is no person.
_LEAST_CONFIDENCE = 0.12
_LEFT = re.compile(r"left|(?<![a-z])l(?=[_. -])|(?<=[_. :-])l(?![a-z])", re.IGNORECASE)
_RIGHT = re.compile(r"right|(?<![a-z])r(?=[_. -])|(?<=[_. :-])r(?![a-z])", re.IGNORECASE)


@dataclass(frozen=True)
class _Limb:
    """Three joints of a limb, what is above them, the tip, and how like a limb it is (0 to 1)."""

    above: int | None
    joints: tuple[int, int, int]
    tip: int | None
    likeness: float


@dataclass(frozen=True)
class _Pair:
    """Two alike branches of a joint: their first joints, and their length."""

    joint: int
    branches: tuple[int, int]
    length: float
    symmetry: float


def match_shape(motion: Motion) -> JointMatch | None:
    """The joints of a person in a motion, found by shape; None if it has none. ``confidence`` says how like
    a person it is, and is lower where left and right are a guess.
    """
    tree = _Tree(motion)
    best: tuple[float, dict[str, int]] | None = None
    for legs, arms in _pairs_of_pairs(tree):
        found = _person(tree, legs, arms)
        if found is not None and (best is None or found[0] > best[0]):
            best = found
    if best is None or best[0] < _LEAST_CONFIDENCE:
        return None
    confidence, roles = best
    roles, sure = _with_sides(motion, roles)
    table = JointTable(name="shape", joints={role: [motion.joint_names[j]] for role, j in roles.items()})  # type: ignore[call-arg]
    match = match_roles(table, roles, motion.joint_names)
    return (
        replace(match, by="shape", confidence=round(min(1.0, float(confidence * sure)), 3))
        if match.complete
        else None
    )


class _Tree:
    """Link lengths and the longest ways down, by joint."""

    def __init__(self, motion: Motion) -> None:
        self.parents = motion.parents
        count = motion.n_joints
        frames = np.unique(np.linspace(0, motion.n_frames - 1, 5).astype(int))
        self.links = np.median(np.linalg.norm(motion.local_translations(frames), axis=-1), axis=0)
        self.links[self.parents < 0] = 0.0
        self.points = motion.world_positions(np.unique(np.linspace(0, motion.n_frames - 1, 60).astype(int)))
        self.children: list[list[int]] = [[] for _ in range(count)]
        for joint in range(count - 1, -1, -1):
            if self.parents[joint] >= 0:
                self.children[int(self.parents[joint])].insert(0, joint)
        #: Longest way from a joint's parent through the joint to a leaf.
        self.reach = self.links.copy()
        self.next = np.full(count, -1)
        for joint in range(count - 1, -1, -1):  # children come after parents
            if self.children[joint]:
                far = max(self.children[joint], key=lambda child: self.reach[child])
                self.reach[joint] += self.reach[far]
                self.next[joint] = far
        self.size = float(self.reach.max(initial=0.0))

    def stiffness(self, a: int, b: int) -> float:
        """1 where two joints are always as far from each other, as the ends of a bone are; less where
        something bends between them.
        """
        if int(self.parents[b]) == a:
            return 1.0
        distance = np.linalg.norm(self.points[:, a] - self.points[:, b], axis=-1)
        return float(np.exp(-0.5 * (distance.std() / max(distance.mean(), 1e-9) / _STIFF) ** 2))

    def chain(self, joint: int) -> list[int]:
        """A branch's longest way, from its first joint to the leaf."""
        out = [joint]
        while self.next[out[-1]] >= 0:
            out.append(int(self.next[out[-1]]))
        return out

    def path(self, joint: int) -> list[int]:
        """A joint and its ancestors, upwards."""
        out = [joint]
        while self.parents[out[-1]] >= 0:
            out.append(int(self.parents[out[-1]]))
        return out

    def pairs(self) -> list[_Pair]:
        """All pairs of alike long branches of one joint (or of joints without length between them)."""
        found = []
        for joint in range(len(self.parents)):
            branches = [child for child in self._branches(joint) if self.reach[child] > 0.15 * self.size]
            for a, b in combinations(branches, 2):
                longer, shorter = sorted((self.reach[a], self.reach[b]), reverse=True)
                if shorter > (1 - _ALIKE) * longer:
                    found.append(_Pair(joint, (a, b), float(longer), float(shorter / longer)))
        return found

    def _branches(self, joint: int) -> Iterator[int]:
        """Children; of a child without length, its children too, since they start at the same place."""
        for child in self.children[joint]:
            yield child
            if self.links[child] < 1e-3 * self.size and len(self.children[child]) > 1:
                yield from self.children[child]


def _pairs_of_pairs(tree: _Tree) -> Iterator[tuple[_Pair, _Pair]]:
    """What may be legs and arms: pairs of branches that share no joint."""
    pairs = sorted(tree.pairs(), key=lambda pair: -pair.length)[:60]
    for legs in pairs:
        for arms in pairs:
            if arms is legs or set(arms.branches) & set(legs.branches):
                continue
            # neither pair lies inside a branch of the other
            inside = any(b in tree.path(a)[1:] for a in (legs.joint, *legs.branches) for b in arms.branches)
            outside = any(b in tree.path(a)[1:] for a in (arms.joint, *arms.branches) for b in legs.branches)
            if (
                not inside
                and not outside
                and legs.joint not in arms.branches
                and arms.joint not in legs.branches
            ):
                yield legs, arms


def _person(tree: _Tree, legs: _Pair, arms: _Pair) -> tuple[float, dict[str, int]] | None:
    """How like a person these legs and arms are, and the roles of their joints; sides as they come."""
    limbs, arm_limbs = _limbs(tree, legs, _LEG, 1.05), _limbs(tree, arms, _ARM, 1.2)
    if limbs is None or arm_limbs is None:
        return None
    roles: dict[str, int] = {"Hips": legs.joint}
    # legs are among the longest there is
    likeness = legs.symmetry * arms.symmetry * min(1.0, 2 * legs.length / tree.size) ** 2
    for side, leg, arm in zip(("Left", "Right"), limbs, arm_limbs, strict=True):
        roles.update(
            {f"{side}{part}": j for part, j in zip(("Hip", "Knee", "Ankle"), leg.joints, strict=True)}
        )
        roles.update(
            {f"{side}{part}": j for part, j in zip(("Shoulder", "Elbow", "Wrist"), arm.joints, strict=True)}
        )
        if leg.tip is not None:
            roles[f"{side}Toe"] = leg.tip
        if arm.above is not None:
            roles[f"{side}Collar"] = arm.above
        if arm.tip is not None:
            roles[f"{side}Fingers"] = arm.tip
        likeness *= leg.likeness * arm.likeness
    leg_length, arm_length = (
        sum(tree.links[j] for j in limb.joints[1:]) for limb in (limbs[0], arm_limbs[0])
    )
    likeness *= _like(arm_length / leg_length, _ARM_BY_LEG, 0.35)
    trunk = _between(tree, legs.joint, arms.joint)
    if trunk is None:
        return None
    # from the joint that hips and trunk hang on, up to the arms
    spine = trunk[trunk.index(_top(tree, trunk)) + 1 :]
    if spine:
        roles["Spine"], roles["Chest"] = spine[0], spine[-1]
    else:
        roles["Chest"] = arms.joint
    length = sum(tree.links[joint] for joint in trunk if joint != _top(tree, trunk))
    likeness *= _like(max(length, 1e-9) / leg_length, 0.55, 0.9)
    head = _head(tree, legs, arms, trunk)
    if head is None:
        return likeness * 0.4, roles
    roles["Head"] = head[-2] if len(head) > 1 else head[-1]
    if len(head) > 2:
        roles["Neck"] = head[0]
    likeness *= _like(sum(tree.links[j] for j in head) / leg_length, _HEAD_BY_LEG, 0.9)
    return likeness ** (1 / 4), roles


def _like(value: float, typical: float, spread: float) -> float:
    """1 where a ratio is typical, falling with its logarithm."""
    return float(np.exp(-0.5 * (np.log(max(value, 1e-9) / typical) / spread) ** 2))


def _limbs(tree: _Tree, pair: _Pair, typical: Array, before: float) -> tuple[_Limb, _Limb] | None:
    """The three joints of each of two limbs: those that part them most like typical ones, the same in both
    where their chains are as long. ``before``: the usual length with what is above the limb, a collar.
    """
    chains = [tree.chain(branch) for branch in pair.branches]
    likely = [_partings(tree, chain, typical, before) for chain in chains]
    if not all(likely):
        return None
    if len(chains[0]) == len(chains[1]):
        both = {at: value * likely[1][at] for at, value in likely[0].items() if at in likely[1]}
        if not both:
            return None
        best = max(both, key=lambda at: both[at])
        chosen = [best, best]
    else:
        chosen = [max(one, key=lambda at, one=one: one[at]) for one in likely]  # type: ignore[misc]
    first, second = (
        _Limb(
            _above(tree, chain, at[0]),
            (chain[at[0]], chain[at[1]], chain[at[2]]),
            _tip(tree, chain, at[2]),
            one[at],
        )
        for chain, at, one in zip(chains, chosen, likely, strict=True)
    )
    return first, second


def _partings(
    tree: _Tree, chain: list[int], typical: Array, before: float
) -> dict[tuple[int, int, int], float]:
    """How like a limb (0 to 1) each three joints of a chain part it, by their places in it."""
    along = np.cumsum([tree.links[joint] for joint in chain])
    found = {}
    for i, j, k in combinations(range(min(len(chain), 16)), 3):
        upper, lower, rest = along[j] - along[i], along[k] - along[j], along[-1] - along[k]
        if min(upper, lower) < 0.12 * along[-1]:
            continue
        likeness = _like(upper / lower, typical[0] / typical[1], 0.22)
        if rest > 0.02 * (upper + lower):
            likeness *= _like(rest / (upper + lower), typical[2] / (typical[0] + typical[1]), 0.6)
        else:
            likeness *= 0.5
        likeness *= _like(1 + (along[i] - along[0]) / (upper + lower), before, 0.25)
        likeness *= tree.stiffness(chain[i], chain[j]) * tree.stiffness(chain[j], chain[k])
        # a limb ends in a joint, not in an end site; few skeletons have joints amid a bone
        likeness *= 1.0 if tree.children[chain[k]] else 0.6
        skipped = sum(tree.links[chain[m]] > 0.08 * (upper + lower) for m in range(i + 1, k) if m != j)
        found[i, j, k] = float(likeness * 0.9**skipped)
    return found


def _above(tree: _Tree, chain: list[int], place: int) -> int | None:
    """The last joint of a chain before a place that is somewhere else: the collar."""
    inner = [chain[m] for m in range(place) if tree.links[chain[m + 1]] > 1e-3 * tree.size]
    return inner[-1] if inner else None


def _tip(tree: _Tree, chain: list[int], joint: int) -> int | None:
    """The first joint after the limb's last that is some way off."""
    for other in chain[joint + 1 :]:
        if tree.links[other] > 0.005 * tree.size:
            return other
    return None


def _between(tree: _Tree, a: int, b: int) -> list[int] | None:
    """Joints from a to b along the tree; None if they are in different trees."""
    up_a, up_b = tree.path(a), tree.path(b)
    common = next((joint for joint in up_a if joint in up_b), None)
    if common is None:
        return None
    return [*up_a[: up_a.index(common) + 1], *reversed(up_b[: up_b.index(common)])]


def _top(tree: _Tree, joints: list[int]) -> int:
    """The joint of a way that all others hang on."""
    return next(joint for joint in joints if int(tree.parents[joint]) not in joints)


def _head(tree: _Tree, legs: _Pair, arms: _Pair, trunk: list[int]) -> list[int] | None:
    """The chain of neck and head: the longest of the other branches at the arms, or just above or below."""
    taken = {*legs.branches, *arms.branches, *trunk}
    near = [arms.joint, *tree.path(arms.joint)[1:2]]
    near = [joint for joint in near if joint != legs.joint or joint == arms.joint]
    branches = [
        child
        for joint in near
        for child in tree.children[joint]
        if child not in taken and not any(branch in tree.chain(child) for branch in taken)
    ]
    branches = [child for child in branches if tree.reach[child] > 0.02 * tree.size]
    return tree.chain(max(branches, key=lambda child: tree.reach[child])) if branches else None


def _with_sides(motion: Motion, roles: dict[str, int]) -> tuple[dict[str, int], float]:
    """Roles with left and right as names tell, or as the feet point; and how sure that is."""

    def said(part: str) -> int:
        """1 if the left ones' names say left, -1 if they say right, 0 if they say nothing."""
        left, right = (motion.joint_names[roles[f"{side}{part}"]] for side in ("Left", "Right"))
        a, b = _side(left), _side(right)
        return 0 if a == b else a - b

    legs, arms = said("Knee") or said("Hip"), said("Elbow") or said("Shoulder")
    sure = 1.0
    if not legs:
        legs, sure = _seen_left(motion, roles, "Hip"), 0.75
    if not arms:
        # as they stand over the hips
        arms, sure = legs * _same_side(motion, roles), min(sure, 0.9)
    out = dict(roles)
    for wrong, parts in (
        (legs < 0, ("Hip", "Knee", "Ankle", "Toe")),
        (
            arms < 0,
            ("Collar", "Shoulder", "Elbow", "Wrist", "Fingers"),
        ),
    ):
        for part in parts if wrong else ():
            pair = {side: out.pop(f"{side}{part}", None) for side in ("Left", "Right")}
            for side, other in (("Left", "Right"), ("Right", "Left")):
                if (joint := pair[other]) is not None:
                    out[f"{side}{part}"] = joint
    return out, sure


def _side(name: str) -> int:
    return bool(_LEFT.search(name)) - bool(_RIGHT.search(name))


def _poses(motion: Motion) -> Array:
    return motion.world_positions(np.unique(np.linspace(0, motion.n_frames - 1, 200).astype(int)))


def _seen_left(motion: Motion, roles: dict[str, int], part: str) -> int:
    """1 if what is called left is, seen from above with the feet pointing ahead (knees bend ahead too)."""
    points = _poses(motion)
    head = points[:, roles.get("Head", roles["Chest"])]
    ankles = (points[:, roles["LeftAnkle"]] + points[:, roles["RightAnkle"]]) / 2
    up = unit_vectors((head - ankles).mean(0))
    across = points[:, roles[f"Left{part}"]] - points[:, roles[f"Right{part}"]]
    votes = np.zeros(len(points))
    for side in ("Left", "Right"):
        ankle = points[:, roles[f"{side}Ankle"]]
        if f"{side}Toe" in roles:
            votes += _votes(across, points[:, roles[f"{side}Toe"]] - ankle, up)
        # knees are ahead of the line from hip to ankle
        hip, knee = points[:, roles[f"{side}Hip"]], points[:, roles[f"{side}Knee"]]
        votes += _votes(across, knee - (hip + ankle) / 2, up)
    return 1 if votes.sum() >= 0 else -1


def _votes(across: Array, ahead: Array, up: Array) -> Array:
    """Above 0 where ``across`` is to the left of ``ahead`` (N, 3)."""
    return np.asarray((np.cross(ahead, -across) @ up) * -1.0)


def _same_side(motion: Motion, roles: dict[str, int]) -> int:
    """1 if left shoulder and left hip are on the same side in most poses."""
    points = _poses(motion)
    hips = points[:, roles["LeftHip"]] - points[:, roles["RightHip"]]
    shoulders = points[:, roles["LeftShoulder"]] - points[:, roles["RightShoulder"]]
    return 1 if (hips * shoulders).sum(-1).sum() >= 0 else -1
