"""The benchmark of pairs says which set the score prefers."""

import pytest
from pairs import read_pairs
from rank_pairs import rank


@pytest.mark.slow
def test_a_drawn_pair_is_ranked_and_timed():
    pair = next(pair for pair in read_pairs() if pair.name == "slow 0, gravity")
    row = rank(pair)
    assert row["ranked rightly"]
    assert row["evidence"] > 0.0
    assert row["CPU s of a score"] > 0.0
