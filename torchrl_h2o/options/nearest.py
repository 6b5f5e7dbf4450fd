"""The nearest of several known names, for the message about a misspelt one."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def did_you_mean(name: object, known: Iterable[str], similarity: float = 0.6) -> str:
    """Returns the end of a message with the known name that is most similar, whatever its case; empty if none is.

    Args:
        name: the misspelt name.
        known: names that would be accepted.
        similarity: smallest similarity of two names, from 0 to 1, as of ``difflib.SequenceMatcher``.

    Examples:
        >>> did_you_mean("h2oplus", ["h2o", "h2o_plus", "sac"])
        '; did you mean h2o_plus?'
        >>> did_you_mean("ppo", ["h2o", "sac"])
        ''
    """
    by_lower = {one.lower(): one for one in known}
    found = get_close_matches(str(name).lower(), by_lower, n=1, cutoff=similarity)
    return f"; did you mean {by_lower[found[0]]}?" if found else ""
