"""SAC: its presets and its search space."""

from gym_mara.agents.algorithms.base import Algorithm, LogRange, Preset, Presets, SearchSpace

# Many arms fill the replay buffer in little time; an update costs far more than a step of all arms. So there are some
# updates for each step of all arms, with large batches, and the replay buffer holds the last 300,000 steps.
_TELEPORTING = Preset(
    num_envs=16,
    policy="sac",
    arguments={
        "learning_starts": 1000,
        "buffer_size": 300_000,
        "batch_size": 256,
        "train_freq": 1,
        "gradient_steps": 2,
        "gamma": 0.0,
        "ent_coef": "auto_0.01",
        "learning_rate": 1e-3,
        "policy_kwargs": {"net_arch": [128, 128]},
    },
)
_TRAVELLING = Preset(
    num_envs=16,
    policy="sac",
    arguments={
        "learning_starts": 2000,
        "buffer_size": 300_000,
        "batch_size": 256,
        "train_freq": 1,
        "gradient_steps": 2,
        "gamma": 0.95,
        "ent_coef": "auto_0.01",
        "tau": 0.01,
        "learning_rate": 7e-4,
        "policy_kwargs": {"net_arch": [128, 128]},
    },
)

ALGORITHM = Algorithm(
    name="sac",
    summary="soft actor-critic, from Stable-Baselines3",
    target="gym_mara.agents.algorithms.off_policy:SAC",
    presets={"tuned": Presets(teleporting=_TELEPORTING, travelling=_TRAVELLING)},
    search_space=SearchSpace(
        arguments={
            "gradient_steps": [1, 2, 4, 8],
            "batch_size": [128, 256, 512],
            "learning_rate": LogRange(1e-4, 3e-3),
            "tau": LogRange(2e-3, 5e-2),
        },
    ),
)
