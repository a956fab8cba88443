"""Joint names in a common spelling: without what all names share, with sides found from pairs of names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache

from humansim_ros.motion.joint_tables import comparison_key

#: Spellings of the sides, at the start or the end of a name.
_SIDES = (("left", "right"), ("l", "r"))
_SEPARATORS = " _.-|:"
#: Left in a name of a joint table, the surest first: as a word or a letter that stands alone; as a letter
#: before a capital; as the first letter.
_LEFT = (
    re.compile(r"left|(?<![a-z])l(?=[_. -])|(?<=[_. :-])l(?![a-z])", re.IGNORECASE),
    re.compile(r"^l(?=[A-Z])"),
    re.compile(r"^l"),
)


@lru_cache(4)
def loose_keys(names: tuple[str, ...]) -> list[str]:
    """Keys of joint names: ``L_UpLeg_x``, ``lUpLeg`` and ``upleg.L`` all become ``left upleg``.

    What all names begin or end with is left out. A letter is a side only if the name of the other side is
    there, too.
    """
    keys = [comparison_key(name) for name in _without_common_parts(names)]
    present = set(keys)
    return [_with_side(key, present) for key in keys]


@lru_cache(1 << 13)
def loose_table_key(role: str, name: str) -> str:
    """Key of a name of a joint table; :func:`loose_keys` gives the same to such a joint."""
    if not role.startswith("Left"):
        return comparison_key(name)
    found = next((match for pattern in _LEFT if (match := pattern.search(name))), None)
    base = name if found is None else name[: found.start()] + name[found.end() :]
    return f"left {comparison_key(base)}"


def _with_side(key: str, present: set[str]) -> str:
    for pair in _SIDES:
        for side, own, other in (("left", *pair), ("right", *reversed(pair))):
            if key.startswith(own) and other + key[len(own) :] in present:
                return f"{side} {key[len(own) :]}"
            if key.endswith(own) and key[: len(key) - len(own)] + other in present:
                return f"{side} {key[: len(key) - len(own)]}"
    return key


def _without_common_parts(names: Sequence[str]) -> list[str]:
    """Names without the beginning and the end that all have, up to a separator."""
    joints = [name for name in names if not name.endswith("_end")]
    if len(joints) < 2:
        return list(names)
    start = _common_start(joints)
    start = start[: 1 + max(start.rfind(mark) for mark in _SEPARATORS)]
    end = _common_start([name[len(start) :][::-1] for name in joints])
    end = end[: 1 + max(end.rfind(mark) for mark in _SEPARATORS)][::-1]
    return [name.removeprefix(start).removesuffix(end) for name in names]


def _common_start(texts: Sequence[str]) -> str:
    """Longest text that all texts begin with."""
    first, last = min(texts), max(texts)  # all others are between them
    length = next((n for n, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), len(first))
    return first[:length]
