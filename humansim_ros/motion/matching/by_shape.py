"""Match the joints of a motion to bones, by names or else by the shape of the skeleton. Refuse animals.

The shape is tree, link lengths and symmetry. Lengths along the tree do not depend on the pose. A person has
two equal legs at one joint, two equal arms at another joint, and a head near the arms. Only left and right
need a pose, if names do not show the sides.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np

from humansim_ros.errors import MotionError
from humansim_ros.geometry import unit_vectors
from humansim_ros.motion.body.kinematics import Motion
from humansim_ros.motion.matching.by_name import (
    LIMBS,
    ancestors,
    detail_joints,
    match_names_in_motion,
    spread_frames,
)
from humansim_ros.motion.matching.joint_tables import (
    LEFT,
    MIN_CONFIDENCE,
    RIGHT,
    JointMatch,
    JointTable,
    match_roles,
)
from humansim_ros.types import Array

#: Two branches are a pair if their lengths differ by this share at most.
_PAIR_TOLERANCE = 0.12
#: Most branches of a joint (the longest), and most pairs that are compared with those of a person.
_MAX_BRANCHES, _MAX_PAIRS = 30, 60
#: Standard deviation of the measured length of a bone, as a share of the length.
_BONE_VARIATION = 0.01
#: Most frames in which signs of an animal are looked for, spread over the motion.
_ANIMAL_FRAMES = 100
#: The trunk stands on the legs if the cosine of the angle between two directions (hips to shoulders, hips to
#: ankles) is at most this value.
_STANDING = -0.7
#: A body is on all fours if the trunk is not opposite to the legs, and arms and legs point to the same side.
#: These are limits of the cosines.
_TRUNK_TO_LEGS, _ARMS_TO_LEGS = -0.6, 0.3
#: Legs of an animal are shorter than the first value, as a multiple of the trunk. Its arms are longer than
#: the second, as a multiple of the legs. People have 1.5 to 2.3 and 0.54 to 0.68; dogs, cats and horses have
#: 0.7 and 0.9 to 1.0.
_SHORT_LEGS, _LONG_ARMS = 1.0, 0.8
#: A body with one sign is an animal if it is on all fours in this share of the frames. A body with two signs
#: is an animal if the trunk is opposite to the legs in less than the second share.
_FOURS, _UPRIGHT = 0.9, 0.5
#: Factors of the confidence for an animal, and for a body that may be an animal.
_ANIMAL, _DOUBTFUL = 0.05, 0.5
#: Parts that a body must have on a side to be examined.
_PARTS = ("Hip", "Knee", "Shoulder", "Elbow")
_TAIL = re.compile(r"tail(?!or)", re.IGNORECASE)


@dataclass(frozen=True)
class BranchPair:
    """Two similar branches of a joint: the first joints of both, and the length of the longer branch."""

    joint: int
    branches: tuple[int, int]
    length: float
    symmetry: float


class JointTree:
    """Tree of the joints of a motion, with the lengths of links and the longest chain below each joint."""

    def __init__(self, motion: Motion) -> None:
        self.names = motion.joint_names
        self.parents = motion.parents
        count = motion.n_joints
        translations = motion.local_translations(spread_frames(motion, 5))
        self.links = np.median(np.linalg.norm(translations, axis=-1), axis=0)
        self.links[self.parents < 0] = 0.0
        self.points = motion.world_positions(spread_frames(motion, 60))
        self.children: list[list[int]] = [[] for _ in range(count)]
        for joint, parent in enumerate(self.parents.tolist()):
            if parent >= 0:
                self.children[parent].append(joint)
        #: Longest way from the parent of a joint through the joint to a leaf.
        self.reach = self.links.copy()
        self.next = np.full(count, -1)
        for joint in range(count - 1, -1, -1):  # children come after their parents
            if self.children[joint]:
                farthest = max(self.children[joint], key=lambda child: self.reach[child])
                self.reach[joint] += self.reach[farthest]
                self.next[joint] = farthest
        self.size = float(self.reach.max(initial=0.0))

    def stiffness(self, a: int, b: int) -> float:
        """1 if the distance of two joints is constant, as along a bone; less if a joint between bends."""
        if int(self.parents[b]) == a:
            return 1.0
        distance = np.linalg.norm(self.points[:, a] - self.points[:, b], axis=-1)
        return float(np.exp(-0.5 * (distance.std() / max(distance.mean(), 1e-9) / _BONE_VARIATION) ** 2))

    def chain(self, joint: int) -> list[int]:
        """Longest chain of a branch, from its first joint to the leaf."""
        out = [joint]
        while self.next[out[-1]] >= 0:
            out.append(int(self.next[out[-1]]))
        return out

    def path(self, joint: int) -> list[int]:
        """A joint and its ancestors, upwards."""
        return [joint, *ancestors(joint, self.parents)]

    def pairs(self) -> list[BranchPair]:
        """Find all pairs of long branches that start at the same joint and are about equally long. Joints at
        the same place count as one joint."""
        pairs = []
        for joint in range(len(self.parents)):
            branches = [child for child in self._branches(joint) if self.reach[child] > 0.15 * self.size]
            if len(branches) > _MAX_BRANCHES:
                shortest = sorted(self.reach[branches], reverse=True)[_MAX_BRANCHES - 1]
                branches = [child for child in branches if self.reach[child] >= shortest][:_MAX_BRANCHES]
            for a, b in combinations(branches, 2):
                longer, shorter = sorted((self.reach[a], self.reach[b]), reverse=True)
                if shorter > (1 - _PAIR_TOLERANCE) * longer:
                    pairs.append(BranchPair(joint, (a, b), float(longer), float(shorter / longer)))
        return pairs

    def _branches(self, joint: int) -> Iterator[int]:
        """Children of a joint, and the children of a child without length: they start at the same place."""
        for child in self.children[joint]:
            yield child
            if self.links[child] < 1e-3 * self.size and len(self.children[child]) > 1:
                yield from self.children[child]


#: Shares of a leg (thigh, shin, foot) and of an arm (upper arm, forearm, hand) of a typical person.
_LEG, _ARM = np.array([0.43, 0.41, 0.16]), np.array([0.42, 0.36, 0.22])
#: Names of the five joints of legs and arms: collar, three main joints and tip.
_LEG_PARTS, _ARM_PARTS = (
    ("", "Hip", "Knee", "Ankle", "Toe"),
    ("Collar", "Shoulder", "Elbow", "Wrist", "Fingers"),
)
#: Length of an arm, and of neck and head, as shares of the length of a leg.
_ARM_BY_LEG, _HEAD_BY_LEG = 0.72, 0.28
#: A hand, a foot or a head has at least this number of children: fingers, toes or parts of a face.
_MANY_CHILDREN = 3
#: The likelihood of a limb is multiplied by this value if the limb does not end at its hand or foot.
_WRONG_END = 0.2
_HAND = re.compile(r"hand|wrist", re.IGNORECASE)
_FOOT = re.compile(r"foot|ankle", re.IGNORECASE)
_HEAD = re.compile(r"head|skull", re.IGNORECASE)


@dataclass(frozen=True)
class _Limb:
    """Collar, three main joints and tip of a limb, and the likelihood of the limb (0 to 1)."""

    collar: int | None
    joints: tuple[int, int, int]
    tip: int | None
    likelihood: float

    def roles(self, parts: Sequence[str]) -> dict[str, int]:
        """Joints by the names of the five parts, without unknown joints."""
        joints = (self.collar, *self.joints, self.tip)
        return {part: joint for part, joint in zip(parts, joints, strict=True) if part and joint is not None}


def match_shape(motion: Motion, min_confidence: float = MIN_CONFIDENCE) -> JointMatch | None:
    """Match the joints of a person by the shape of the skeleton. None if the motion has no person.

    A motion has no person if its similarity to a person is below ``min_confidence``.

    The ``confidence`` of the match is the similarity to a person, lower if left and right are uncertain.
    """
    tree = JointTree(motion)
    best: tuple[float, dict[str, int]] | None = None
    for legs, arms in _limb_pairs(tree):
        person = _person(tree, legs, arms)
        if person is not None and (best is None or person[0] > best[0]):
            best = person
    if best is None or best[0] < min_confidence:
        return None
    likelihood, roles = best
    roles, side_confidence = _assign_sides(motion, roles)
    names = {role: [motion.joint_names[j]] for role, j in roles.items()}
    match = match_roles(
        JointTable.model_validate({"name": "shape", "joints": names}), roles, motion.joint_names
    )
    if not match.complete:
        return None
    # a motion is not refused only because its sides are uncertain
    confidence = round(min(1.0, max(float(likelihood * side_confidence), min(likelihood, MIN_CONFIDENCE))), 3)
    return replace(match, by="shape", confidence=confidence)


def _limb_pairs(tree: JointTree) -> Iterator[tuple[BranchPair, BranchPair]]:
    """Candidates for legs and arms: two pairs of branches that have no joint in common."""
    pairs = sorted(tree.pairs(), key=lambda pair: -pair.length)[:_MAX_PAIRS]
    above = [{joint for start in (p.joint, *p.branches) for joint in tree.path(start)[1:]} for p in pairs]
    for (legs, above_legs), (arms, above_arms) in permutations(zip(pairs, above, strict=True), 2):
        if not (
            {*above_legs, *legs.branches, legs.joint} & {*arms.branches}
            or {*above_arms, arms.joint} & {*legs.branches}
        ):
            yield legs, arms


def _person(tree: JointTree, legs: BranchPair, arms: BranchPair) -> tuple[float, dict[str, int]] | None:
    """Likelihood and roles of a person with these legs and arms; sides undecided. None if they do not fit."""
    leg_limbs, arm_limbs = _limbs(tree, legs, _LEG, 1.05, _FOOT), _limbs(tree, arms, _ARM, 1.2, _HAND)
    trunk = _path_between(tree, legs.joint, arms.joint)
    if leg_limbs is None or arm_limbs is None or trunk is None:
        return None
    roles: dict[str, int] = {"Hips": legs.joint}
    # legs are among the longest branches
    likelihood = legs.symmetry * arms.symmetry * min(1.0, 2 * legs.length / tree.size) ** 2
    for side, leg, arm in zip(("Left", "Right"), leg_limbs, arm_limbs, strict=True):
        parts = leg.roles(_LEG_PARTS) | arm.roles(_ARM_PARTS)
        roles |= {side + part: joint for part, joint in parts.items()}
        likelihood *= leg.likelihood * arm.likelihood
    leg_length, arm_length = (
        sum(tree.links[j] for j in limb.joints[1:]) for limb in (leg_limbs[0], arm_limbs[0])
    )
    likelihood *= _similarity(arm_length / leg_length, _ARM_BY_LEG, 0.35)
    # from the last common joint of hips and trunk up to the arms
    topmost = next(joint for joint in trunk if int(tree.parents[joint]) not in trunk)
    spine = trunk[trunk.index(topmost) + 1 :]
    roles |= {"Spine": spine[0], "Chest": spine[-1]} if spine else {"Chest": arms.joint}
    length = sum(tree.links[joint] for joint in trunk if joint != topmost)
    likelihood *= _similarity(max(length, 1e-9) / leg_length, 0.55, 0.9)
    head = _head(tree, legs, arms, trunk)
    if head is None:
        return likelihood * 0.4, roles
    top = _end_of_chain(tree, head, _HEAD, from_place=0)
    if top is None:
        top = max(len(head) - 2, 0)
    roles["Head"] = head[top]
    if top > 0:
        roles["Neck"] = head[0]
    head = head[: top + 2]
    likelihood *= _similarity(sum(tree.links[j] for j in head) / leg_length, _HEAD_BY_LEG, 0.9)
    return likelihood ** (1 / 4), roles


def _similarity(ratio: float, typical: float, spread: float) -> float:
    """Similarity of a ratio to a typical one: 1 if equal, less by the logarithm of the deviation."""
    return float(np.exp(-0.5 * (np.log(max(ratio, 1e-9) / typical) / spread) ** 2))


def _end_of_chain(tree: JointTree, chain: list[int], called: re.Pattern[str], from_place: int) -> int | None:
    """Index of hand, foot or head in a chain, found by its name or its children. None if not found."""
    places = range(from_place, len(chain))
    for place in places:
        if tree.children[chain[place]] and called.search(tree.names[chain[place]]):
            return place
    return next((place for place in places if len(tree.children[chain[place]]) >= _MANY_CHILDREN), None)


def _limbs(
    tree: JointTree, pair: BranchPair, typical: Array, above: float, end: re.Pattern[str]
) -> list[_Limb] | None:
    """Find the most likely three joints of both limbs. If their chains are equally long, both limbs use the
    same indices of their chains.

    Args:
        tree: Joint tree.
        pair: First joints of the limbs.
        typical: (3,) shares of the three parts of a limb.
        above: Usual length of limb and collar together, as a multiple of the length of the limb alone.
        end: Names of the third joint.
    """
    chains = [tree.chain(branch) for branch in pair.branches]
    likelihoods = [_joint_triples(tree, chain, typical, above, end) for chain in chains]
    one, other = likelihoods
    if len(chains[0]) == len(chains[1]):
        both = {places: value * other[places] for places, value in one.items() if places in other}
        ranks = [both, both]
    else:
        ranks = likelihoods
    if not all(ranks):
        return None
    chosen = [max(rank, key=rank.__getitem__) for rank in ranks]
    return [
        _Limb(
            _collar(tree, chain, places[0]),
            (chain[places[0]], chain[places[1]], chain[places[2]]),
            _tip(tree, chain, places[2]),
            likelihood[places],
        )
        for chain, places, likelihood in zip(chains, chosen, likelihoods, strict=True)
    ]


def _joint_triples(
    tree: JointTree, chain: list[int], typical: Array, above: float, end: re.Pattern[str]
) -> dict[tuple[int, int, int], float]:
    """Return, for the indices of three joints in a chain, the likelihood (0 to 1) that these joints form a
    limb. The parameters are the same as in :func:`_limbs`."""
    last = _end_of_chain(tree, chain, end, from_place=2)
    along = np.cumsum([tree.links[joint] for joint in chain])
    likelihoods = {}
    for i, j, k in combinations(range(min(len(chain), 16)), 3):
        upper, lower, rest = along[j] - along[i], along[k] - along[j], along[-1] - along[k]
        if min(upper, lower) < 0.12 * along[-1]:
            continue
        likelihood = _similarity(upper / lower, typical[0] / typical[1], 0.22)
        if rest > 0.02 * (upper + lower):
            likelihood *= _similarity(rest / (upper + lower), typical[2] / (typical[0] + typical[1]), 0.6)
        else:
            likelihood *= 0.5
        likelihood *= _similarity(1 + (along[i] - along[0]) / (upper + lower), above, 0.25)
        likelihood *= tree.stiffness(chain[i], chain[j]) * tree.stiffness(chain[j], chain[k])
        # a limb ends in a joint, not in an end site. Few skeletons have joints in the middle of a bone
        likelihood *= 1.0 if tree.children[chain[k]] else 0.6
        skipped = sum(tree.links[chain[m]] > 0.08 * (upper + lower) for m in range(i + 1, k) if m != j)
        likelihood *= 1.0 if last in (None, k) else _WRONG_END
        likelihoods[i, j, k] = float(likelihood * 0.9**skipped)
    return likelihoods


def _collar(tree: JointTree, chain: list[int], place: int) -> int | None:
    """Last joint of a chain before ``place`` that is at another position than the joint at ``place``."""
    inner = [chain[m] for m in range(place) if tree.links[chain[m + 1]] > 1e-3 * tree.size]
    return inner[-1] if inner else None


def _tip(tree: JointTree, chain: list[int], place: int) -> int | None:
    """First joint of a chain after ``place`` that is at another position than the joint at ``place``."""
    return next((joint for joint in chain[place + 1 :] if tree.links[joint] > 0.005 * tree.size), None)


def _path_between(tree: JointTree, a: int, b: int) -> list[int] | None:
    """Joints from a to b along the tree. None if a and b are in different trees."""
    up_a, up_b = tree.path(a), tree.path(b)
    common = next((joint for joint in up_a if joint in up_b), None)
    if common is None:
        return None
    return [*up_a[: up_a.index(common) + 1], *reversed(up_b[: up_b.index(common)])]


def _head(tree: JointTree, legs: BranchPair, arms: BranchPair, trunk: list[int]) -> list[int] | None:
    """Chain of neck and head: the longest branch except the arms, at the joint of the arms or its parent."""
    used = {*legs.branches, *arms.branches, *trunk}
    near = [arms.joint, *tree.path(arms.joint)[1:2]]
    near = [joint for joint in near if joint != legs.joint or joint == arms.joint]
    branches = [
        child
        for joint in near
        for child in tree.children[joint]
        if child not in used and not any(branch in tree.chain(child) for branch in used)
    ]
    branches = [child for child in branches if tree.reach[child] > 0.02 * tree.size]
    return tree.chain(max(branches, key=lambda child: tree.reach[child])) if branches else None


def _assign_sides(motion: Motion, roles: dict[str, int]) -> tuple[dict[str, int], float]:
    """Decide left and right by names, else by the direction of the feet. Returns roles and confidence."""

    def named_side(part: str) -> int:
        """1 if the names agree with left and right, -1 if they are swapped, 0 if they do not tell."""
        left, right = (motion.joint_names[roles[f"{side}{part}"]] for side in ("Left", "Right"))
        a, b = (bool(LEFT.search(name)) - bool(RIGHT.search(name)) for name in (left, right))
        return 0 if a == b else a - b

    legs, arms = named_side("Knee") or named_side("Hip"), named_side("Elbow") or named_side("Shoulder")
    confidence = 1.0
    if not legs:
        legs, confidence = _posed_side(motion, roles), 0.75
    if not arms:
        # arms get the sides of the hips that are below them
        arms, confidence = legs * _shoulders_above_hips(motion, roles), min(confidence, 0.9)
    swapped = (*(_LEG_PARTS if legs < 0 else ()), *(_ARM_PARTS if arms < 0 else ()))
    other = {f"Left{part}": f"Right{part}" for part in swapped}
    other |= {right: left for left, right in other.items()}
    return {other.get(role, role): joint for role, joint in roles.items()}, confidence


def _sampled_positions(motion: Motion) -> Array:
    return motion.world_positions(spread_frames(motion, 200))


def _posed_side(motion: Motion, roles: dict[str, int]) -> int:
    """1 if the left hip is on the left of the direction of feet and knees, seen from above. Else -1."""
    points = _sampled_positions(motion)
    head = points[:, roles.get("Head", roles["Chest"])]
    ankles = (points[:, roles["LeftAnkle"]] + points[:, roles["RightAnkle"]]) / 2
    up = unit_vectors((head - ankles).mean(0))
    across = points[:, roles["LeftHip"]] - points[:, roles["RightHip"]]
    votes = np.zeros(len(points))
    for side in ("Left", "Right"):
        ankle = points[:, roles[f"{side}Ankle"]]
        if f"{side}Toe" in roles:
            votes += _left_of(across, points[:, roles[f"{side}Toe"]] - ankle, up)
        # knees are in front of the line from hip to ankle
        hip, knee = points[:, roles[f"{side}Hip"]], points[:, roles[f"{side}Knee"]]
        votes += _left_of(across, knee - (hip + ankle) / 2, up)
    return 1 if votes.sum() >= 0 else -1


def _left_of(across: Array, forward: Array, up: Array) -> Array:
    """Numbers (N,), positive where ``across`` (N, 3) points to the left of ``forward`` (N, 3)."""
    return np.asarray((np.cross(forward, -across) @ up) * -1.0)


def _shoulders_above_hips(motion: Motion, roles: dict[str, int]) -> int:
    """1 if left shoulder and left hip are on the same side in most poses, else -1."""
    points = _sampled_positions(motion)
    hips = points[:, roles["LeftHip"]] - points[:, roles["RightHip"]]
    shoulders = points[:, roles["LeftShoulder"]] - points[:, roles["RightShoulder"]]
    return 1 if (hips * shoulders).sum(-1).sum() >= 0 else -1


def animal_signs(motion: Motion, roles: Mapping[str, int]) -> tuple[float, tuple[str, ...]]:
    """Look for signs of an animal in a motion with joints ``roles``.

    Because a person may crawl, several signs must come together. Returns the factor of the confidence that
    this is a person (1 for a plausible body), and the signs in words. A body without shoulders or elbows has
    no signs.
    """
    if not all(side + part in roles for side in ("Left", "Right") for part in _PARTS):
        return 1.0, ()
    points = motion.world_positions(spread_frames(motion, _ANIMAL_FRAMES))
    trunk, legs, arms = _directions(points, roles)
    leg, arm = (_length(points, roles, limb) for limb in LIMBS)
    leg_by_trunk = leg / max(float(np.median(np.linalg.norm(trunk, axis=-1))), 1e-9)
    arm_by_leg = arm / max(leg, 1e-9)
    proportions = leg_by_trunk < _SHORT_LEGS and arm_by_leg > _LONG_ARMS
    tail = _tail(motion, roles)
    upright = _cosine(trunk, legs) < _TRUNK_TO_LEGS
    fours = float((~upright & (_cosine(arms, legs) > _ARMS_TO_LEGS)).mean())
    at_rest, legs_at_rest, _ = _directions(motion.rest_positions()[None], roles)
    stands = bool(_cosine(at_rest, legs_at_rest)[0] < _STANDING)
    signs = bool(tail) + proportions
    moves = (signs == 1 and fours >= _FOURS) or (signs == 2 and upright.mean() < _UPRIGHT)
    is_animal = moves and not stands
    if not is_animal and not proportions and (fours < _FOURS or stands):
        return 1.0, ()
    reasons = []
    if fours >= _UPRIGHT:
        reasons.append(f"the body is on all fours in {fours:.0%} of the frames")
    if proportions:
        reasons += [
            f"the legs are {leg_by_trunk:.1f} times as long as the trunk (a person's: 1.5 to 2.3)",
            f"the arms {arm_by_leg:.1f} times as long as the legs (a person's: 0.5 to 0.7)",
        ]
    if tail:
        reasons.append(f"it has a tail ({', '.join(tail[:2])})")
    return _ANIMAL if is_animal else _DOUBTFUL, tuple(reasons)


def _directions(points: Array, roles: Mapping[str, int]) -> tuple[Array, Array, Array]:
    """Vectors (F, 3) of poses (F, J, 3): hips to shoulders, hips to ankles, shoulders to wrists. Knees and
    elbows replace unknown ankles and wrists."""

    def middle(part: str, instead: str = "") -> Array:
        joints = (roles.get(side + part, roles.get(side + instead, -1)) for side in ("Left", "Right"))
        return np.asarray(sum(points[:, joint] for joint in joints) / 2)

    hips, shoulders = middle("Hip"), middle("Shoulder")
    return shoulders - hips, middle("Ankle", "Knee") - hips, middle("Wrist", "Elbow") - shoulders


def _length(points: Array, roles: Mapping[str, int], limb: tuple[str, str, str]) -> float:
    """Mean length of a limb of both sides. The length of each side is the median over all poses."""
    lengths = []
    for side in ("Left", "Right"):
        joints = [roles[side + part] for part in limb if side + part in roles]
        links = np.linalg.norm(np.diff(points[:, joints], axis=1), axis=-1)
        lengths.append(float(np.median(links.sum(1))))
    return sum(lengths) / 2


def _cosine(a: Array, b: Array) -> Array:
    """Cosines (F,) of the angles between vectors (F, 3)."""
    return np.asarray((unit_vectors(a) * unit_vectors(b)).sum(-1))


def _tail(motion: Motion, roles: Mapping[str, int]) -> tuple[str, ...]:
    """Names of joints of a tail. Hair (a ponytail) and coats above the shoulders do not count."""
    upper = {roles[role] for role in ("Neck", "Head", "LeftShoulder", "RightShoulder") if role in roles}
    tails = ((joint, name) for joint, name in enumerate(motion.joint_names) if _TAIL.search(name))
    return tuple(n for joint, n in tails if upper.isdisjoint((joint, *ancestors(joint, motion.parents))))


def match_motion(
    motion: Motion, table: str | os.PathLike[str] | None = None, min_confidence: float | None = None
) -> JointMatch:
    """Match the joints of a motion to bones.

    If ``table`` is given (name of a built-in table, or a YAML file), this table is used. Otherwise the
    built-in table is used that best fits names and hierarchy. If none fits, the shape of the skeleton
    decides. Signs of an animal lower the confidence.

    Raises:
        MotionError: The table does not fit, or the motion is not that of a person: the confidence is below
            ``min_confidence`` (by default 0.12).
    """
    min_confidence = MIN_CONFIDENCE if min_confidence is None else min_confidence
    try:
        match = match_names_in_motion(motion, table)
    except MotionError as by_names:
        if table is not None:
            raise
        by_shape = match_shape(motion, min_confidence)
        if by_shape is None:
            message = f"{by_names.message}. Nor has the skeleton the shape of a person"
            raise MotionError(message, path=motion.path) from None
        match = replace(by_shape, details=detail_joints(motion.joint_names, by_shape.roles, motion.parents))
    factor, reasons = animal_signs(motion, match.roles)
    if factor < 1:
        # a motion is not refused for reasons alone
        least = 0.0 if factor == _ANIMAL else min(match.confidence, MIN_CONFIDENCE)
        match = replace(match, confidence=max(match.confidence * factor, least), reasons=reasons)
    if match.confidence < min_confidence:
        animal = f" but rather an animal: {', '.join(match.reasons)}" if match.reasons else ""
        raise MotionError(
            f"this is not a person{animal} (confidence {match.confidence:.1%}, below {min_confidence:.0%}). "
            "To play it nevertheless, set min_confidence to 0 (--min-confidence 0)",
            path=motion.path,
        )
    return match


def is_person(motion: Motion) -> bool:
    """Whether the joints of a motion are those of a person."""
    try:
        match_motion(motion)
    except MotionError:
        return False
    return True
