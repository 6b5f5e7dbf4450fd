"""Finds which elements of a model belong together by their names: the thighs, the feet, the left leg."""

import re
from collections.abc import Sequence

_SIDES = "bflr"  # back, front, left, right: bthigh and fthigh are thighs


def families(names: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """Groups of at least two names that share a word.

    Words are what stands between digits, underscores and other marks; a letter for the side in front
    of a word is taken off too, where that makes a group. A group that several words make is there
    once, under the first of them.

    Args:
        names: the names; one without letters is in no group.

    Returns:
        The indices of the names in each group, by the shared word.

    Examples:
        >>> families(["torso", "bthigh", "bfoot", "fthigh", "ffoot"])
        {'thigh': (1, 3), 'foot': (2, 4)}
        >>> families(["thigh_joint", "leg_joint", "thigh_left_joint", "leg_left_joint"])
        {'thigh': (0, 2), 'joint': (0, 1, 2, 3), 'leg': (1, 3), 'left': (2, 3)}
    """
    words = [re.findall(r"[^\W\d_]+", name) for name in names]
    sided = [[word[1:] for word in own if word[0].lower() in _SIDES and len(word) > 3] for own in words]
    # whole words go first: "left" makes the same group as "eft"
    groups = {}
    for candidates in (words, [own + bare for own, bare in zip(words, sided, strict=True)]):
        for word in dict.fromkeys(word for own in candidates for word in own):
            members = tuple(i for i, own in enumerate(candidates) if word in own)
            if len(members) > 1 and members not in groups.values():
                groups.setdefault(word, members)
    return groups
