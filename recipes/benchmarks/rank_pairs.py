"""Measures how often the score prefers the right one of two sets of effects; see pairs.yaml.

python recipes/benchmarks/rank_pairs.py                       # the simulated pairs, some minutes
python recipes/benchmarks/rank_pairs.py logs=../shared/data   # with those of measured logs

Writes outputs/benchmark/rank_pairs/pairs.csv with a row for each pair.
"""

import time
from pathlib import Path

import numpy as np
import pandas as pd
from joblib import Parallel, delayed
from options import read_options
from pairs import Pair, read_pairs

import torchrl_h2o.quiet  # noqa: F401  (silences other packages)
from torchrl_h2o.effects import Effect
from torchrl_h2o.residuals import Measured
from torchrl_h2o.residuals.score import Difference
from torchrl_h2o.residuals.search import NATS_OF_SURPRISE, Ground, surprise_of
from torchrl_h2o.residuals.settings import DEFAULTS


def main() -> None:
    cfg = read_options(logs=None, names=None, processes=2, folder="outputs/benchmark/rank_pairs")
    pairs = read_pairs(None if cfg.logs is None else Path(cfg.logs))
    chosen = [index for index, pair in enumerate(pairs) if cfg.names is None or pair.name in cfg.names]
    rows, folder = [], Path(cfg.folder)
    folder.mkdir(parents=True, exist_ok=True)
    for row in Parallel(cfg.processes, return_as="generator_unordered")(
        delayed(_row)(index, cfg.logs) for index in chosen
    ):
        rows.append(row)
        pd.DataFrame(rows).to_csv(folder / "pairs.csv", index=False)
        right = sum(one["ranked rightly"] for one in rows)
        print(f"{right:3} of {len(rows):3}  {row}", flush=True)


def _row(index: int, logs: str | None) -> dict:
    pair = read_pairs(None if logs is None else Path(logs))[index]
    try:
        return rank(pair)
    except Exception as error:  # a failed pair must not end the others, and counts as ranked wrongly
        return {"pair": pair.name, "kind": pair.kind, "ranked rightly": False, "error": repr(error)[:200]}


def rank(pair: Pair) -> dict:
    """Compares both sets from start states that are filtered with the one and with the other."""
    simulation, by_block, seconds = pair.simulation, [], {"start states": 0.0, "scores": 0.0}
    measured = Measured.from_ted(pair.data, simulation)
    for effects in (pair.right, pair.wrong):
        begin = time.process_time()
        model = Ground.of(simulation, measured, effects).model
        filtered = time.process_time()
        by_block.append(model.scores(pair.right) - model.scores(pair.wrong))
        seconds["start states"] += filtered - begin
        seconds["scores"] += time.process_time() - filtered
    difference = Difference(np.mean(by_block, axis=0))
    prior = _prior(pair.right) - _prior(pair.wrong)
    return {
        "pair": pair.name,
        "kind": pair.kind,
        "ranked rightly": bool(difference.evidence + prior > 0.0),
        "nats a block": round(difference.mean, 3),
        "standard error": round(difference.error, 3),
        "evidence": round(difference.evidence, 1),
        "prior": round(prior, 1),
        "blocks": len(difference.by_block),
        "CPU s of start states": round(seconds["start states"] / 2.0, 2),
        "CPU s of a score": round(seconds["scores"] / 4.0, 2),
    }


def _prior(effects: tuple[Effect, ...]) -> float:
    """Logarithm of the prior probability of effects, in nats: the level for each kind, and less for unusual ones."""
    return len({type(effect) for effect in effects}) * np.log(DEFAULTS.level) - NATS_OF_SURPRISE * surprise_of(effects)


if __name__ == "__main__":
    main()
