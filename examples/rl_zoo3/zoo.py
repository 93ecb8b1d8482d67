"""RL Baselines3 Zoo with ACKTR as an additional algorithm.

python examples/rl_zoo3/zoo.py train --algo acktr --env gym_mara/MARA-v0 --conf-file examples/rl_zoo3/acktr.yml -f /tmp/zoo
python examples/rl_zoo3/zoo.py enjoy --algo acktr --env gym_mara/MARA-v0 -f /tmp/zoo --no-render -n 2048
"""

from __future__ import annotations

import sys

import gym_mara  # noqa: F401 - registers the environments, as --gym-packages does
from gym_mara.agents.algorithms.acktr import ACKTR
from gym_mara.extras import needs

with needs("this example", "zoo"):
    from rl_zoo3 import ALGOS
    from rl_zoo3.enjoy import enjoy
    from rl_zoo3.train import train

# All modules of the zoo share this dictionary: add to it, do not replace it.
ALGOS["acktr"] = ACKTR


def main() -> None:
    """Run the zoo's own command."""
    # Not with rl_zoo3.cli, which also needs the plotting libraries of the zoo.
    commands = {"train": train, "enjoy": enjoy}
    if sys.argv[1:2] == [] or sys.argv[1] not in commands:
        sys.exit(f"usage: zoo.py {'|'.join(commands)} …")
    commands[sys.argv.pop(1)]()


if __name__ == "__main__":
    main()
