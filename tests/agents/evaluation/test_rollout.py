"""Trajectories: what is recorded of a step is what the task judged."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gym_mara.agents.evaluation.episodes import episode_seeds
from gym_mara.agents.evaluation.rollout import Act, roll_out
from gym_mara.agents.runs.evaluation import Player
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.envs.simulation import Simulation
from gym_mara.types import Floats

COLLIDING_Q = (0.0, 2.3, 1.3, 0.0, 0.0, 0.0)
"""A configuration in which MARA touches the table or itself."""
STEPS = 8


class Alternating(Player):
    """It goes to a colliding configuration in every second step, and home in the others."""

    count = 0

    def begin(self, simulation: Simulation) -> Act:
        return self.act

    def act(self, observation: Floats) -> Floats:
        self.count += 1
        home = self.env.simulation.robot.home
        q = np.array(COLLIDING_Q) if self.count % 2 else home
        return np.tile(q, (len(observation), 1))


@pytest.mark.parametrize("on_collision", ["reset", "continue"])
def test_a_trajectory_holds_the_poses_that_were_judged(
    finished_run: RunFolder, on_collision: str
) -> None:
    options: dict[str, Any] = {"on_collision": on_collision}
    with Alternating(finished_run, "pinocchio", options, arms=2) as player:
        played = roll_out(player.env, player.begin, episode_seeds(0, 0, 2), STEPS)
    assert played.collided[0].all(), "the arm collides at once"
    assert not played.collided.all(), "and not at home"
    distance = np.linalg.norm(played.tool - played.target, axis=-1)
    np.testing.assert_allclose(distance, played.position_error, rtol=0.0, atol=1e-12)
    at_collisions = played.q[played.collided]
    np.testing.assert_allclose(at_collisions, np.tile(COLLIDING_Q, (len(at_collisions), 1)))
    assert played.steps.all()
    np.testing.assert_array_equal(played.q[0], played.action[0])


def test_an_episode_ends_where_the_task_ends_it(finished_run: RunFolder) -> None:
    options = {"on_collision": "terminate"}
    with Alternating(finished_run, "pinocchio", options, arms=2) as player:
        played = roll_out(player.env, player.begin, episode_seeds(0, 0, 2), STEPS)
    assert played.steps.shape == (1, 2), "both arms collided in the first step"
    assert played.collided.all()


def test_an_arm_whose_episode_has_ended_counts_no_further_step(finished_run: RunFolder) -> None:
    class OneCollides(Alternating):
        def act(self, observation: Floats) -> Floats:
            return np.vstack([super().act(observation)[:1], self.env.simulation.robot.home])

    options = {"on_collision": "terminate"}
    with OneCollides(finished_run, "pinocchio", options, arms=2) as player:
        played = roll_out(player.env, player.begin, episode_seeds(0, 0, 2), STEPS)
    assert played.steps.sum(axis=0).tolist() == [1, STEPS]
