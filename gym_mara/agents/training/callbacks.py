"""The callback of a training: checkpoints, evaluations, logging and progress."""

from __future__ import annotations

import time
from collections.abc import Callable

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from gym_mara.agents.evaluation.episodes import MOST_SEED, play_episodes
from gym_mara.agents.evaluation.metrics import spread
from gym_mara.agents.runs.evaluation import episodes_to_judge, make_arms
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.agents.runs.policy import base_env, policy_of, save_policy
from gym_mara.agents.training.checkpoint import Progress, state_files
from gym_mara.agents.training.learning_curve import plot_learning_curve
from gym_mara.agents.training.replay import remove_replay
from gym_mara.envs import MaraVectorEnv
from gym_mara.registration import environment

OnProgress = Callable[[int, dict[str, float]], None]
"""Called with the number of steps so far and the values to show."""
_ROW_EVERY = 2000
"""The least steps between two rows of the table for an off-policy algorithm, whose rollouts may be a single step."""


class CheckpointCallback(BaseCallback):
    """Writes checkpoints, evaluates the deterministic policy, saves the best one, and logs the training reward.

    All this happens before a rollout starts, when neither environment nor policy is in the middle of something. A run
    resumed from a checkpoint therefore gives the same result, to the bit, as one that was never interrupted.

    Args:
        run: the folder to write to.
        reached: what the training has reached before.
        on_progress: called after every rollout.
    """

    def __init__(self, run: RunFolder, reached: Progress, on_progress: OnProgress) -> None:
        super().__init__()
        self.run = run
        self.best = reached.best
        self._started = time.monotonic() - reached.elapsed
        self.on_progress = on_progress
        self.shown: dict[str, float] = {}
        self._next = 0
        self._recorded = 0
        """The steps up to which rewards are recorded."""
        self._eval_env: MaraVectorEnv | None = None

    def _on_training_start(self) -> None:
        self._recorded = self.num_timesteps
        config = self.run.config
        self._next = self.num_timesteps + config.checkpoint_every
        if config.start is not None and not self.run.checkpoints():
            self._next = 0  # the policy of the other run is evaluated, and kept here
        episodes = episodes_to_judge(config)
        self._eval_env = make_arms(
            config.env, config.backend, episodes, config.env_options, max_episode_steps=None
        )

    def _on_rollout_start(self) -> None:
        # The model's own count: Stable-Baselines3 updates the callback's only during the rollout.
        if self.model.num_timesteps >= self._next:
            self._next = self.model.num_timesteps + self.run.config.checkpoint_every
            self.checkpoint()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        least = _ROW_EVERY if isinstance(self.model, OffPolicyAlgorithm) else 0
        if self.model.num_timesteps - self._recorded >= least:
            self._record_reward()
            self.model.dump_logs()
        self.on_progress(self.model.num_timesteps, self.shown)

    def _record_reward(self) -> None:
        """Record the mean reward of the steps since the last record, if there are any."""
        env = base_env(self.model)
        steps = self.model.num_timesteps - self._recorded
        if steps:
            self.shown["reward_per_step"] = env.reward_sum / steps
            self.logger.record("rollout/reward_per_step", self.shown["reward_per_step"])
        self._recorded, env.reward_sum = self.model.num_timesteps, 0.0

    def _on_training_end(self) -> None:
        self.checkpoint()
        plot_learning_curve(self.run)
        # This marks the run as finished. A finished run needs no replay buffer.
        save_policy(self.run.path / "last", self.model)
        remove_replay(self.run.checkpoints())

    def close(self) -> None:
        """Close the environment of the evaluations."""
        if self._eval_env is not None:
            self._eval_env.close()

    def checkpoint(self) -> None:
        """Evaluate, save the policy if it is the best so far, and write a checkpoint."""
        model = self.model
        steps = model.num_timesteps
        self._record_reward()
        for name, value in self._evaluate().items():
            self.logger.record(f"eval/{name}", value)
            self.shown[f"eval_{name}"] = value
        self.shown["evaluations"] = self.shown.get("evaluations", 0) + 1
        elapsed = time.monotonic() - self._started
        self.logger.record("time/total_timesteps", steps)
        self.logger.record("time/time_elapsed", round(elapsed, 1))
        self.logger.dump(steps)
        if self.shown["eval_reward_per_step"] > self.best:
            self.best = self.shown["eval_reward_per_step"]
            save_policy(self.run.path / "best", model)
        files = state_files(model, Progress(self.best, elapsed))
        save_policy(self.run.path / "checkpoints" / str(steps), model, files)
        remove_replay(self.run.checkpoints()[:-1])

    def _evaluate(self) -> dict[str, float]:
        """The mean of each metric that an episode has, of the policy as it is saved."""
        assert self._eval_env is not None
        config = self.run.config
        metrics = play_episodes(
            self._eval_env,
            policy_of(self.model).begin,
            steps=environment(config.env).max_episode_steps,
            episodes=self._eval_env.num_envs,
            seed=MOST_SEED + 1 + config.seed,  # the same episodes in every evaluation
        )
        return {name: each["mean"] for name, each in spread(metrics).items() if each}
