"""Behaviour cloning on a data set of Minari: a network imitates inverse kinematics, and is evaluated as every policy is.

The data set is that of gym-mara record, with observations that are arrays. Without one, episodes of inverse kinematics on
MARAReach-v0 are recorded first.

    python examples/behaviour_cloning.py --data reach-v0
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import minari
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from gym_mara.agents.evaluation.metrics import METRICS, mean_in_short
from gym_mara.agents.runs.evaluation import measure_acting
from gym_mara.datasets.playing import record
from gym_mara.datasets.sources import baseline

BATCH, LEARNING_RATE, HIDDEN = 512, 1e-3, 256
OF_PICTURES = {"task", "backend", "render_mode", "width", "height"}
"""Keyword arguments of a data set's environment that an evaluation has not."""


class Clone(nn.Module):
    """Actions for observations, which it normalises with the mean and the deviation of the data set."""

    def __init__(self, observations: Tensor, actions: int) -> None:
        super().__init__()
        deviation, self.mean = torch.std_mean(observations, 0)
        self.deviation = deviation.clamp(min=1e-3)
        self.layers = nn.Sequential(
            nn.Linear(observations.shape[1], HIDDEN),
            nn.ReLU(),
            nn.Linear(HIDDEN, HIDDEN),
            nn.ReLU(),
            nn.Linear(HIDDEN, actions),
        )

    def forward(self, observations: Tensor) -> Tensor:
        """The actions (N, A) for observations (N, O)."""
        actions: Tensor = self.layers((observations - self.mean) / self.deviation)
        return actions

    def act(self, observations: NDArray[np.float64]) -> NDArray[np.float64]:
        """The same, as the environment takes them."""
        with torch.no_grad():
            actions: Tensor = self(torch.tensor(observations).float())
        return actions.numpy().astype(np.float64)


def pairs(data: Any) -> tuple[Tensor, Tensor]:
    """The observations (S, O) and the actions (S, A) of the episodes that end in success, until the arm is there.

    After that inverse kinematics follows its own rounding errors, with actions that nobody can learn.
    """
    observations, actions = [], []
    for episode in data.iterate_episodes():
        success = episode.infos["success"]
        if success[-1]:
            steps = int(np.argmax(success))
            observations.append(episode.observations[:steps])
            actions.append(episode.actions[:steps])
    if not observations:
        raise SystemExit("no episode of the data set ends in success: nothing to imitate")
    columns = (np.concatenate(each) for each in (observations, actions))
    of_steps, acted = (torch.tensor(column).float() for column in columns)
    return of_steps, acted


def clone(observations: Tensor, actions: Tensor, steps: int) -> Clone:
    """Train a network to answer observations with the actions."""
    torch.manual_seed(0)
    network = Clone(observations, actions.shape[1])
    optimiser = torch.optim.Adam(network.parameters(), LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        chosen = torch.randint(len(observations), (BATCH,))
        loss = nn.functional.smooth_l1_loss(network(observations[chosen]), actions[chosen])
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call] # of torch
        optimiser.step()
        schedule.step()
    print(f"loss of the last batch: {loss.item():.5f}")
    return network


def main() -> None:
    """Record a data set if none is given, train, and evaluate in episodes that are not in it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="a data set of gym-mara record --format minari")
    parser.add_argument("--episodes", type=int, default=1000, help="to record without --data")
    parser.add_argument("--steps", type=int, default=10_000, help="of the optimiser")
    parser.add_argument("--evaluate", type=int, default=1000, help="episodes of the evaluation")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = arguments.data or Path(folder) / "ik-v0"
        if arguments.data is None:
            source = baseline("ik", "MARAReach-v0", "pinocchio", {"guide": True})
            print(record(source, "minari", path, episodes=arguments.episodes))
        data = minari.MinariDataset(path / "data")
        observations, actions = pairs(data)
    network = clone(observations, actions, arguments.steps)
    spec: Any = data.spec.env_spec
    options = {name: v for name, v in spec.kwargs.items() if name not in OF_PICTURES}
    measured = measure_acting(
        lambda _: network.act,
        spec.id,
        spec.kwargs.get("backend", "pinocchio"),
        options,
        episodes=arguments.evaluate,
        seed=0,
    )
    for name in ("success_percent", "collision_percent", "position_error_mm"):
        print(f"{METRICS[name]}: {mean_in_short(name, measured[name])}")


if __name__ == "__main__":
    main()
