"""The benchmark of pairs says which set the score prefers."""

import pytest

rank_pairs = pytest.importorskip("rank_pairs", reason="recipes/benchmarks is not importable")


@pytest.mark.slow
def test_a_drawn_pair_is_ranked_and_timed():
    pair = next(pair for pair in rank_pairs.read_pairs() if pair.name == "slow 0, gravity")
    row = rank_pairs.rank(pair)
    assert row["ranked rightly"]
    assert row["evidence"] > 0.0
    assert row["CPU s an evaluation"] > 0.0
