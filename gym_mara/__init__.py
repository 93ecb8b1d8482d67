"""gym_mara: Gymnasium environments for the modular robot arm MARA and other arms. Importing it registers them."""

from gymnasium.envs.registration import register

from gym_mara.tasks import MAX_EPISODE_STEPS, TASKS

__version__ = "0.1.0"

for _name in TASKS:
    register(
        id=f"gym_mara/{_name}",
        entry_point="gym_mara.envs:MaraEnv",
        vector_entry_point="gym_mara.envs:MaraVectorEnv",
        kwargs={"task": _name},
        max_episode_steps=MAX_EPISODE_STEPS,
    )

register(
    id="gym_mara/MARAGoal-v0",
    entry_point="gym_mara.envs:MaraGoalEnv",
    vector_entry_point="gym_mara.envs:MaraGoalVectorEnv",
    max_episode_steps=50,
)
