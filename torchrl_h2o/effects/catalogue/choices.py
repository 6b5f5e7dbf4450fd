"""The selections that a catalogue tries: single elements, families of elements, and all elements."""

import re
from collections.abc import Collection, Sequence

from torchrl_h2o.effects import selection
from torchrl_h2o.effects.selection import Indices, Names

_SIDES = "bflr"  # prefixes back, front, left and right of MuJoCo's models: bthigh and fthigh are thighs


def named_choices(
    paths: Sequence[tuple[str, str]],
    eligible: Sequence[int],
    *,
    passed_over: Collection[int] = (),
    groups: bool = True,
) -> dict[Names, tuple[int, ...]]:
    """Returns selections by name patterns; no two of them select the same elements.

    Args:
        paths: the names (body, element) of all elements of the kind. Unnamed elements are selected by their body.
        eligible: the indices of the elements to select.
        passed_over: indices that a pattern may select in addition, because the effect does not change them.
        groups: whether to also select families and all elements.

    Returns:
        The selected indices, by selection.

    Examples:
        >>> paths = [("torso", "hip"), ("bthigh", "bknee"), ("fthigh", "fknee")]
        >>> named_choices(paths, [0, 1, 2])
        {'hip': (0,), 'bknee': (1,), 'fknee': (2,), '*knee*': (1, 2), '*': (0, 1, 2)}
    """
    labels = {i: paths[i][1] or (f"{paths[i][0]}/*" if paths[i][0] else "") for i in eligible}
    wanted: list[tuple[tuple[int, ...], tuple[Names, ...]]]
    wanted = [((i,), (label,)) for i, label in labels.items() if label]
    if groups and eligible:
        for word, members in families([paths[i][1] for i in eligible]).items():
            indices = tuple(eligible[i] for i in members)
            everything = ("*",) if len(indices) == len(eligible) else ()
            wanted.append((indices, (*everything, f"*{word}*", tuple(labels[i] for i in indices))))
        wanted.append((tuple(eligible), ("*", tuple(labels.values()))))
    chosen: dict[Names, tuple[int, ...]] = {}
    for indices, patterns in wanted:
        for pattern in patterns:
            if "" in (pattern if isinstance(pattern, tuple) else (pattern,)):  # an element without a name
                continue
            selected = tuple(i for i in selection.matching(paths, pattern, "element") if i not in passed_over)
            if selected == indices and indices not in chosen.values():
                chosen[pattern] = indices
    return chosen


def indexed_choices(
    names: Sequence[str], *, groups: bool = False, singles: bool = True
) -> dict[Indices, tuple[int, ...]]:
    """Returns selections by indices; no two of them select the same entries.

    Args:
        names: the names of all entries, ``""`` for an entry without a name.
        groups: whether to also select families.
        singles: whether to also select single entries.

    Returns:
        The selected indices, by selection.

    Examples:
        >>> indexed_choices(["left_wheel", "right_wheel", "arm"], groups=True)
        {None: (0, 1, 2), (0,): (0,), (1,): (1,), (2,): (2,), (0, 1): (0, 1)}
    """
    everything = tuple(range(len(names)))
    if not everything:
        return {}
    chosen: dict[Indices, tuple[int, ...]] = {None: everything}
    if singles and len(everything) > 1:
        chosen |= {(i,): (i,) for i in everything}
    if groups:
        chosen |= {members: members for members in families(names).values() if members != everything}
    return chosen


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
