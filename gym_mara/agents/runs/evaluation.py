"""Plays a run's deterministic policy: step by step, or over many episodes that are measured."""

from __future__ import annotations

import math
from types import TracebackType
from typing import Any

from typing_extensions import Self

from gym_mara.agents.evaluation.episodes import arms_of_a_batch, episode_seeds, play_episodes
from gym_mara.agents.evaluation.rollout import Act, Begin
from gym_mara.agents.runs.config import check_options
from gym_mara.agents.runs.folder import RunConfig, RunFolder
from gym_mara.agents.runs.policy import load_policy
from gym_mara.agents.sb3 import MaraVecEnv, require_numpy
from gym_mara.agents.scaling import unit_box
from gym_mara.backends import backend_settings
from gym_mara.envs import MaraVectorEnv, make_vector_env
from gym_mara.envs.outcome import Outcome
from gym_mara.envs.simulation import Simulation
from gym_mara.envs.travel import travel_velocity
from gym_mara.registration import environment
from gym_mara.robot import RobotModel
from gym_mara.robot.options import ROBOT_KEYWORDS
from gym_mara.types import Floats

_OTHER_ROBOT = {*ROBOT_KEYWORDS} - {"package_dirs"}
"""The keyword arguments that make another robot; `package_dirs` only says where its files are."""
RANDOM_EPISODES = 5
"""How many episodes judge a policy where they are random: as many as in Stable-Baselines3's `EvalCallback`."""


def make_arms(
    env: str,
    backend: str,
    num_envs: int,
    options: dict[str, Any],
    *,
    autoreset_mode: str = "SameStep",
    **limit: Any,
) -> MaraVectorEnv:
    """N arms of an environment, in at most `workers` processes, a divisor of N; `limit` may be `max_episode_steps`."""
    workers = options.get("workers")
    if type(workers) is int and workers > 0:
        options = {**options, "workers": math.gcd(workers, num_envs)}
    arms = make_vector_env(
        env, num_envs, backend=backend, autoreset_mode=autoreset_mode, **limit, **options
    )
    require_numpy(arms)
    return arms


def make_env(
    env: str, backend: str, num_envs: int, options: dict[str, Any], **limit: Any
) -> MaraVecEnv:
    """N arms of an environment for the agents of the presets, with actions in [-1, 1]."""
    arms = make_arms(env, backend, num_envs, options, **limit)
    return MaraVecEnv(arms, unit_box(len(arms.simulation.action_space.low)))


def episodes_to_judge(config: RunConfig, if_random: int = RANDOM_EPISODES) -> int:
    """How many episodes judge a policy of this run: one where all are the same, else `if_random`."""
    env = make_arms(config.env, config.backend, 1, config.env_options)
    try:
        return if_random if env.simulation.random else 1
    finally:
        env.close()


class Playing:
    """A deterministic policy on N arms of one backend, at the start of episodes without a time limit.

    Use it in a `with` statement.

    Args:
        env: the name of the environment.
        backend: the name of the backend.
        options: keyword arguments of the environment.
        begin: what acts; it refuses a simulation that the policy does not fit.
        arms: N.
        autoreset_mode: "SameStep" begins the next episode in the step that ends one; with "Disabled" the arm stays where an
            episode has ended, and the next step is an error.

    Raises:
        GymMaraError: the policy does not fit the environment, or an option is unknown or out of range.
    """

    def __init__(
        self,
        env: str,
        backend: str,
        options: dict[str, Any],
        begin: Begin,
        *,
        arms: int = 1,
        autoreset_mode: str = "SameStep",
    ) -> None:
        self.env_name = env
        """The name of the environment."""
        self.episode_steps = environment(env).max_episode_steps
        """The length of an episode, steps."""
        self.options = options
        """The keyword arguments of the environment."""
        self._begin = begin
        self.env = make_arms(
            env, backend, arms, options, autoreset_mode=autoreset_mode, max_episode_steps=None
        )
        try:
            self._observation, _ = self.env.reset(seed=episode_seeds(0, 0, arms))
            self._act = self.begin(self.env.simulation)
        except BaseException:
            self.env.close()
            raise

    def step(self) -> Outcome:
        """Let the policy act for one step; the outcome holds the state that the task judged."""
        self._observation, *_ = self.env.step(self._act(self._observation))
        outcome = self.env.simulation.outcome
        assert outcome is not None
        return outcome

    def begin(self, simulation: Simulation) -> Act:
        """What acts in the episodes of an evaluation."""
        return self._begin(simulation)

    @property
    def velocity_limit(self) -> float | None:
        """If the joints teleport, the velocity limit with which they travel, rad/s; see `gym_mara.envs.travel`."""
        return travel_velocity(self.env.simulation)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.env.close()


class Player(Playing):
    """A run's deterministic policy on N arms of one backend, at the start of episodes without a time limit.

    Args:
        run: the run.
        backend: the backend.
        options: keyword arguments of the environment, from `options_on`; the policy's action mode and steps are added.
        which: the policy, "last" or "best".
        arms, autoreset_mode: as in `Playing`.

    Raises:
        GymMaraError: the policy is missing, damaged or of another environment or robot, or an option is unknown or out of range.
    """

    def __init__(
        self,
        run: RunFolder,
        backend: str,
        options: dict[str, Any],
        *,
        which: str = "last",
        arms: int = 1,
        autoreset_mode: str = "SameStep",
    ) -> None:
        self.policy = policy = load_policy(run, which)

        def begin(simulation: Simulation) -> Act:
            policy.check(simulation, any_robot=chose_robot(options))
            return policy.begin(simulation)

        keywords = policy.about.keywords(backend, options)
        super().__init__(
            run.config.env, backend, keywords, begin, arms=arms, autoreset_mode=autoreset_mode
        )


def evaluate_run(
    run: RunFolder,
    *,
    backend: str | None = None,
    episodes: int = 10,
    seed: int = 0,
    which: str = "last",
    options: dict[str, Any] | None = None,
) -> dict[str, Floats]:
    """Play episodes with a run's deterministic policy.

    Args:
        run: the run.
        backend: the backend to play on; by default the one that the run was trained on.
        episodes: the number of episodes.
        seed: of the evaluation; an episode depends on it and on the episode's number alone (`episode_seeds`).
        which: the policy, "last" or "best".
        options: keyword arguments of the environment, in addition to those of the run.

    Returns:
        Each of METRICS per episode (episodes,); see `gym_mara.agents.evaluation.metrics.measure`.

    Raises:
        GymMaraError: the policy is missing, damaged, or of another environment or robot; episodes is out of its range; or
            an option is unknown.
    """
    backend = backend or run.config.backend
    settings = options_on(backend, run.config, options)
    return measure_run(run, backend, settings, episodes=episodes, seed=seed, which=which)[0]


def measure_run(
    run: RunFolder, backend: str, options: dict[str, Any], *, episodes: int, seed: int, which: str
) -> tuple[dict[str, Floats], float | None]:
    """As `evaluate_run`, with complete options; also returns the player's `velocity_limit`."""
    arms = arms_of_a_batch(episodes, environment(run.config.env).max_episode_steps)
    with Player(run, backend, options, which=which, arms=arms) as player:
        steps, limit = player.episode_steps, player.velocity_limit
        played = play_episodes(player.env, player.begin, steps=steps, episodes=episodes, seed=seed)
    return played, limit


def measure_acting(
    begin: Begin, env: str, backend: str, options: dict[str, Any], *, episodes: int, seed: int
) -> dict[str, Floats]:
    """Play the episodes that `evaluate_run` plays, with anything that acts.

    Args:
        begin: what acts.
        env: the name of the environment.
        backend: the name of the backend.
        options: keyword arguments of the environment.
        episodes: the number of episodes.
        seed: of the evaluation.

    Returns:
        Each of METRICS per episode (episodes,).

    Raises:
        GymMaraError: a name is unknown, a value is out of its range, or `begin` refuses the environment.
    """
    steps = environment(env).max_episode_steps
    count = arms_of_a_batch(episodes, steps)
    arms = make_arms(env, backend, count, options, max_episode_steps=None)
    try:
        return play_episodes(arms, begin, steps=steps, episodes=episodes, seed=seed)
    finally:
        arms.close()


def options_on(
    backend: str, config: RunConfig, options: dict[str, Any] | None = None
) -> dict[str, Any]:
    """The keyword arguments of a run's environment; on another backend without the settings of the run's own.

    Args:
        backend: the name of the backend.
        config: the configuration of the run.
        options: keyword arguments that replace those of the run. With one that changes the robot, it is loaded here, and the
            policy may play on a robot that differs from that of the training.

    Raises:
        GymMaraError: a name cannot be an option of a run, or the robot cannot be loaded.
    """
    own = config.env_options if backend == config.backend else options_beyond_backend(config)
    return with_options(own, options or {})


def with_options(own: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    """The keyword arguments of a run's environment, some of them replaced as in `options_on`."""
    check_options(given, pictures=True)
    if isinstance(given.get("robot"), RobotModel):  # nothing of the run's robot is left
        own = {name: value for name, value in own.items() if name not in ROBOT_KEYWORDS}
    merged = {**own, **given}
    if given.keys() & _OTHER_ROBOT:
        of_robot = {name: merged.pop(name) for name in ROBOT_KEYWORDS if name in merged}
        merged["robot"] = RobotModel.load(of_robot.pop("robot", "mara"), **of_robot)
    return merged


def chose_robot(options: dict[str, Any]) -> bool:
    """Whether these options, of `options_on`, have a robot that was given in addition to those of the run."""
    return isinstance(options.get("robot"), RobotModel)


def options_beyond_backend(config: RunConfig) -> dict[str, Any]:
    """The keyword arguments of a run's environment, without the settings of its backend."""
    own = backend_settings(config.backend)
    return {name: value for name, value in config.env_options.items() if name not in own}
