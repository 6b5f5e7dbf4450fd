"""Times functions in turns, repeated several times, so that other load on the machine affects all of them alike."""

import time
from collections.abc import Callable, Mapping

import torch
from tqdm import tqdm

WARM_UP = 10  # calls


def calls_per_second(
    functions: Mapping[str, Callable[[], object]],
    seconds: float,
    turns: int,
    device: str = "cpu",
    least: int = WARM_UP,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Calls per second of each function, the best of several turns.

    Args:
        functions: by name.
        seconds: length of one turn.
        turns: number of turns of each function, after one to warm up.
        device: of the computation; a GPU is synchronised.
        least: minimum number of calls in a turn.
        clock: seconds of wall time, or ``time.process_time``, which on one thread does not count the time that other
            processes take.
    """
    synchronise = torch.cuda.synchronize if torch.device(device).type == "cuda" else lambda: None
    best = dict.fromkeys(functions, 0.0)
    with tqdm(desc="measuring", total=len(functions) * (1 + turns), unit=" turns") as bar:
        for turn in range(1 + turns):
            for name, function in functions.items():
                bar.set_postfix_str(name)
                synchronise()
                start, calls = clock(), 0
                while calls < least or (turn and clock() - start < seconds):
                    function()
                    calls += 1
                synchronise()
                if turn:  # the first is to warm up
                    best[name] = max(best[name], calls / (clock() - start))
                bar.update()
    return best
