"""The selections that a catalogue tries: single elements, families of elements, and all elements."""

from collections.abc import Collection, Sequence

from torchrl_h2o.effects import selection
from torchrl_h2o.effects.catalogue.families import families
from torchrl_h2o.effects.indices import Indices
from torchrl_h2o.effects.selection import Names


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
