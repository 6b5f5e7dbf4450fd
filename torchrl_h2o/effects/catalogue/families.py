"""Groups the elements of a model by shared words in their names, such as thighs, feet or the left leg."""

import re
from collections.abc import Sequence

_SIDES = "bflr"  # prefixes back, front, left and right of MuJoCo's models: bthigh and fthigh are thighs


def families(names: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """Returns groups of at least two names that share a word.

    Words are separated by digits, underscores and other marks. A word also counts without its leading letter for the
    side (b, f, l, r). If several words form the same group, the group is listed once, under the first word.

    Args:
        names: the names; a name without letters belongs to no group.

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
    # whole words first, so that a group is named "left" rather than "eft"
    groups = {}
    for candidates in (words, [own + bare for own, bare in zip(words, sided, strict=True)]):
        for word in dict.fromkeys(word for own in candidates for word in own):
            members = tuple(i for i, own in enumerate(candidates) if word in own)
            if len(members) > 1 and members not in groups.values():
                groups.setdefault(word, members)
    return groups
