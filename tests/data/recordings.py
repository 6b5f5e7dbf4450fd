"""Generated recordings: episodes of given lengths in which all numbers differ."""

import numpy as np
import torch
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_h2o.data.readers.ted import to_ted


def make_arrays(lengths, endings, seed=0, observations=3, actions=2):
    """Returns arrays of whole episodes; ``endings`` states for each whether it terminated."""
    rng = np.random.default_rng(seed)
    states = [rng.normal(size=(length + 1, observations)).astype(np.float32) for length in lengths]
    steps = sum(lengths)
    last = np.cumsum(lengths) - 1
    terminated, truncated = np.zeros(steps, bool), np.zeros(steps, bool)
    terminated[last], truncated[last] = endings, ~np.array(endings)
    return {
        "observation": np.concatenate([values[:-1] for values in states]),
        "next_observation": np.concatenate([values[1:] for values in states]),
        "action": rng.uniform(-1, 1, size=(steps, actions)).astype(np.float32),
        "reward": rng.normal(size=steps).astype(np.float32),
        "terminated": terminated,
        "truncated": truncated,
    }


def make_recording(lengths=(4, 1, 3), endings=(True, False, False), **kwargs) -> TensorDict:
    """Returns the same episodes as a flat TED TensorDict."""
    return to_ted(**make_arrays(lengths, endings, **kwargs))


def assert_same(found: TensorDict, expected: TensorDict) -> None:
    """Asserts that every entry equals that of ``expected``, including its dtype."""
    for key in expected.keys(True, True):
        torch.testing.assert_close(found[key], expected[key], rtol=0, atol=0, msg=str(key))


def recordings() -> st.SearchStrategy[TensorDict]:
    """A strategy for a few episodes, each terminated or truncated."""
    episode = st.tuples(st.integers(1, 5), st.booleans())
    return st.builds(
        lambda drawn, seed: make_recording(*zip(*drawn, strict=True), seed=seed),
        st.lists(episode, min_size=1, max_size=5),
        st.integers(0, 2**16),
    )
