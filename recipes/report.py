"""Makes tables and figures of the results of paper.py in outputs/results/, beside the paper's own numbers.

python recipes/report.py                              # all groups with results
python recipes/report.py groups=[returns] updates=50000
python recipes/report.py groups=[wheel_legged] runs=outputs/paper    # with the robot's trajectories
python recipes/report.py groups=[] by_seed=[wheel_legged]      # seconds balanced, a line per variant, a column per seed
python recipes/report.py results=. groups=[mine] +references.Hopper-v5=[0,3200]    # mine.csv; scores 0 and 100
"""

import torchrl_h2o.quiet  # noqa: F401, I001  (before the packages that it keeps quiet)

import sys
from pathlib import Path

from omegaconf import DictConfig

from torchrl_h2o.commands.hydra_main import hydra_main
from torchrl_h2o.comparison.grids import FIGURES, TABLES
from torchrl_h2o.comparison.options import ReportOptions
from torchrl_h2o.comparison.results_file import RESULTS, read_rows, require_groups
from torchrl_h2o.comparison.robot_figures import draw_robot
from torchrl_h2o.comparison.robot_trajectories import robot_results
from torchrl_h2o.comparison.scores import REFERENCES, MixedRunsError
from torchrl_h2o.comparison.tables import of_one_budget, report, report_off_dynamics, report_seeds


@hydra_main("config", "report", ReportOptions)
def main(cfg: DictConfig) -> None:
    results, paper = Path(cfg.results or RESULTS), read_rows(Path(__file__).with_name("paper.csv"))
    to = Path(cfg.to or results)
    require_groups(results, [*cfg.groups, *cfg.by_seed], TABLES | FIGURES)
    references = REFERENCES | {env: tuple(returns) for env, returns in cfg.references.items()}
    refused = []
    for group in cfg.groups:
        try:
            rows = of_one_budget(read_rows(results / f"{group}.csv"), cfg.updates, group)
            if not len(rows):
                asked = "" if cfg.updates is None else f" of {cfg.updates} updates"
                print(f"{group}: no run{asked} in {results / group}.csv")
                continue
            if group == "off_dynamics":
                report_off_dynamics(rows, to)
                continue
            report(group, rows, results, to, references, paper, cfg.reps)
        except MixedRunsError as error:
            refused.append(str(error))
            continue
        if group == "wheel_legged":
            draw_robot(to, robot_results(Path(cfg.runs) / group, rows))
    for group in cfg.by_seed:
        report_seeds(results, group, to, tuple(cfg.at))
    if refused:
        sys.exit("\n".join(refused))


if __name__ == "__main__":
    main()
