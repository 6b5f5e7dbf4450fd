"""Measures how often the score prefers the right one of two sets of effects; see pairs.yaml.

python recipes/benchmarks/rank_pairs.py                       # the simulated pairs, some minutes
python recipes/benchmarks/rank_pairs.py logs=../shared/data   # with those of measured logs

Writes outputs/benchmark/rank_pairs/pairs.csv with a row for each pair.
"""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from joblib import Parallel, delayed
from options import read_options
from pairs import Pair, read_pairs

import torchrl_h2o.quiet  # noqa: F401  (silences other packages)
from torchrl_h2o.effects import Effect
from torchrl_h2o.likelihood import ENOUGH, Difference
from torchrl_h2o.residuals import Measured
from torchrl_h2o.residuals.ground import NATS_OF_SURPRISE, Ground, surprise_of
from torchrl_h2o.residuals.score import Model


def main() -> None:
    cfg = read_options(logs=None, names=None, processes=2, folder="outputs/benchmark/rank_pairs")
    if cfg.logs is not None and not Path(cfg.logs).is_dir():
        raise SystemExit(f"logs={cfg.logs}: there is no such folder; give the folder of the measured logs")
    pairs = read_pairs(None if cfg.logs is None else Path(cfg.logs))
    for unknown in set(cfg.names or ()) - {pair.name for pair in pairs}:
        raise SystemExit(f"names=[{unknown}]: choose names of pairs.yaml; those of measured logs need logs=FOLDER")
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
    """Compares both sets, each predicting from the start states that are filtered with it."""
    simulation, begin = pair.simulation, time.process_time()
    measured = Measured.from_ted(pair.data, simulation)
    sets = (pair.right, pair.wrong)
    models = [Ground.of(simulation, measured, effects).base for effects in sets]
    # windows count as little as the more alike errors of the two sets make them
    counts = tuple(np.minimum(*both) for both in zip(*(model.fit.counts for model in models), strict=True))
    models = [Model(*(replace(part, counts=counts) for part in (model.fit, model.selection))) for model in models]
    filtered = time.process_time()
    right, wrong = (model.scores() for model in models)
    scored = time.process_time()
    difference = Difference(right - wrong)
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
        "CPU s of start states": round((filtered - begin) / 2.0, 2),
        "CPU s of a score": round((scored - filtered) / 2.0, 2),
    }


def _prior(effects: tuple[Effect, ...]) -> float:
    """Logarithm of the prior probability of effects, in nats: 100 times less for each kind, less for unusual ones."""
    return -ENOUGH * len({type(effect) for effect in effects}) - NATS_OF_SURPRISE * surprise_of(effects)


if __name__ == "__main__":
    main()
