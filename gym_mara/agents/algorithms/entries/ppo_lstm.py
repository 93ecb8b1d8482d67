"""PPO with a memory, RecurrentPPO: its presets and its search space."""

from gym_mara.agents.algorithms.base import Algorithm, LogRange, Preset, Presets, SearchSpace

# As for PPO γ = 0, because the next state depends on the action alone, and many short updates. The noise is independent for each
# joint, because the policy "natural" has no memory.
_TELEPORTING = Preset(
    num_envs=64,
    policy="lstm",
    arguments={
        "n_steps": 4,
        "batch_size": 128,
        "n_epochs": 4,
        "gamma": 0.0,
        "learning_rate": ((0.0, 3e-3), (1.0, 0.0)),
        "clip_range": 0.2,
        "policy_kwargs": {"net_arch": [64], "lstm_hidden_size": 64, "log_std_init": -2.0},
    },
)
_TRAVELLING = Preset(
    num_envs=16,
    policy="lstm",
    arguments={
        "n_steps": 256,
        "batch_size": 512,
        "n_epochs": 10,
        "gamma": 0.98,
        "gae_lambda": 0.95,
        "learning_rate": ((0.0, 1e-3), (1.0, 0.0)),
        "clip_range": 0.2,
        "policy_kwargs": {"net_arch": [64], "lstm_hidden_size": 64, "log_std_init": -1.5},
    },
)
# As for PPO, with a smaller network behind the memory.
_ANY_TARGET = Preset(
    num_envs=256,
    policy="lstm",
    normalise_observation=True,
    arguments={
        "n_steps": 16,
        "batch_size": 1024,
        "n_epochs": 3,
        "gamma": 0.98,
        "gae_lambda": 0.95,
        "learning_rate": ((0.0, 1e-3), (1.0, 0.0)),
        "clip_range": 0.2,
        "policy_kwargs": {
            "net_arch": [128],
            "lstm_hidden_size": 128,
            "log_std_init": -0.5,
            "activation_fn": "ReLU",
        },
    },
)

ALGORITHM = Algorithm(
    name="ppo-lstm",
    summary="proximal policy optimisation with an LSTM, from sb3-contrib",
    target="sb3_contrib:RecurrentPPO",
    presets={"tuned": Presets(_TELEPORTING, _TRAVELLING, {"any_target": _ANY_TARGET})},
    search_space=SearchSpace(
        arguments={
            "n_steps": [2, 4, 8],
            "n_epochs": [2, 4, 8],
            "learning_rate": LogRange(3e-4, 3e-2),
        },
        policy_kwargs={"lstm_hidden_size": [32, 64, 128]},
    ),
)
