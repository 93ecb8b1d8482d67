"""rl_zoo3 with ACKTR among its algorithms: train, enjoy, plot_train, plot_from_file and all_plots, as rl_zoo3 has them.

python examples/rl_zoo3/zoo.py train --algo acktr --env gym_mara/MARA-v0 --gym-packages gym_mara \
    --conf-file examples/rl_zoo3/acktr.yml -f logs
python examples/rl_zoo3/zoo.py enjoy --algo acktr --env gym_mara/MARA-v0 --gym-packages gym_mara -f logs
"""

from __future__ import annotations

from typing import Any

import optuna
from rl_zoo3 import ALGOS
from rl_zoo3.cli import main
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

from gym_mara.agents.acktr import ACKTR


def sample(trial: optuna.Trial, *_: Any) -> dict[str, Any]:
    """What --optimize-hyperparameters varies of ACKTR; the rest is as in the configuration file."""
    return {
        "learning_rate": trial.suggest_float("learning_rate", 1e-2, 1.0, log=True),
        "target_kl": trial.suggest_float("target_kl", 3e-4, 3e-2, log=True),
        "damping": trial.suggest_float("damping", 1e-3, 1e-1, log=True),
        "n_steps": trial.suggest_categorical("n_steps", [8, 16, 32, 64]),
    }


# rl_zoo3's scripts share these three.
ALGOS["acktr"] = ACKTR
HYPERPARAMS_SAMPLER["acktr"] = sample
HYPERPARAMS_CONVERTER["acktr"] = dict

if __name__ == "__main__":
    main()
