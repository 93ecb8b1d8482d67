"""The environments on the dynamic backends: torques, contacts, random parameters and divergence."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from gym_mara.backends.dart.backend import DartBackend
from gym_mara.backends.mujoco.backend import MujocoBackend
from gym_mara.backends.servo import SimulationDivergedError
from gym_mara.envs import MaraEnv, MaraVectorEnv
from gym_mara.errors import GymMaraError
from gym_mara.testing import COLLIDING_Q, COPIES
from tests.helpers import ENV_IDS

RANGES = {
    "mass": (0.8, 1.2),
    "effort_limit": (0.9, 1.0),
    "servo_gain": (0.8, 1.2),
    "joint_friction": (0.0, 0.5),
    "contact_friction": (0.5, 1.0),
    "latency": (0.0, 0.04),
    "sensor_noise": (0.0, 1e-3),
}
KEYWORDS: dict[str, Any] = {
    "control_period": 0.04,
    "physics_step": 0.002,
    "max_joint_velocity": 1.2,
    "servo_gain": 12.0,
    "on_divergence": "truncate",
    "randomisation": RANGES,
    "velocity_filter": 0.05,
    "on_collision": "terminate",
    "target_position": [-0.3, 0.1, 0.8],
}
STILL = np.zeros(6, np.float32)


@pytest.fixture(params=["dart", "mujoco"])
def backend(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def in_one_process(backend: str) -> dict[str, Any]:
    """The keyword arguments of environments on this backend that start no process."""
    return {"backend": backend} | ({"workers": 1} if backend == "dart" else {})


def _steps(env: MaraEnv, count: int, seed: int = 0) -> list[Any]:
    """The results of random actions."""
    rng = np.random.default_rng(seed)
    return [env.step(rng.uniform(-2.0, 2.0, 6).astype(np.float32)) for _ in range(count)]


@pytest.mark.filterwarnings("ignore:.*has a wrapper applied")
@pytest.mark.parametrize("name", [ENV_IDS[0], ENV_IDS[3]])
@pytest.mark.parametrize("check", [check_env, sb3_check_env], ids=["gymnasium", "sb3"])
@pytest.mark.parametrize("options", [{}, {"randomisation": RANGES}], ids=["plain", "random"])
def test_the_checkers_accept_the_environments_with_rescaled_actions(
    backend: str,
    name: str,
    check: Callable[[gymnasium.Env[Any, Any]], None],
    options: dict[str, Any],
) -> None:
    env = gymnasium.make(name, backend=backend, disable_env_checker=True, **options)
    rescaled = gymnasium.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
    check(rescaled)
    rescaled.close()


def test_the_same_keywords_run_on_both_engines() -> None:
    played = {}
    for backend in ("dart", "mujoco"):
        envs = MaraVectorEnv(2, "MARACollisionOrient-v0", backend=backend, **KEYWORDS)
        envs.reset(seed=7)
        for _ in range(25):
            *_, info = envs.step(np.full((2, 6), 0.4))
        played[backend] = envs.simulation.backend.state.q, info
        envs.close()
    (q, info), (expected_q, expected) = played["mujoco"], played["dart"]
    assert info.keys() == expected.keys()
    for name in RANGES:
        np.testing.assert_array_equal(info[name], expected[name], err_msg=name)
    np.testing.assert_allclose(q, expected_q, atol=2e-3)


def test_info_has_torques_and_contacts(backend: str) -> None:
    env = MaraEnv("MARACollision-v0", backend=backend, start_q=COLLIDING_Q, on_collision="continue")
    with pytest.warns(
        UserWarning, match="start_q .* is in collision, .*: motor4_link, motor5_link, table"
    ):
        _, info = env.reset(seed=0)
    assert info["contacts"]
    _, _, _, _, info = env.step(np.array(COLLIDING_Q, np.float32))
    assert info["collided"]
    assert info["joint_torque"].shape == (6,)
    assert all(contact["depth"] >= 0.0 for contact in info["contacts"])
    assert "table" in {link for contact in info["contacts"] for link in contact["links"]}


def test_a_collision_resets_the_arm_to_its_start(backend: str) -> None:
    env = MaraEnv("MARACollision-v0", backend=backend)
    env.reset()
    for _ in range(200):
        observation, _, terminated, truncated, info = env.step(np.array(COLLIDING_Q, np.float32))
        assert not terminated
        assert not truncated
        if info["collided"]:
            break
    assert info["contacts"]
    assert np.abs(observation[:6]).max() > 1.0
    assert np.abs(env.step(STILL)[0][:6]).max() < 1e-6


def test_each_episode_draws_new_random_parameters_from_the_seed(backend: str) -> None:
    env = MaraEnv(backend=backend, randomisation=RANGES)
    drawn = []
    for seed in (3, None, None, 3, None):
        _, info = env.reset(seed=seed)
        drawn.append({name: np.array(info[name]) for name in RANGES})
        for name, (low, high) in RANGES.items():
            assert ((drawn[-1][name] >= low) & (drawn[-1][name] <= high)).all()
    assert str(drawn[0]) == str(drawn[3])
    assert str(drawn[1]) == str(drawn[4])
    assert len({str(d) for d in drawn}) == 3
    later = env.step(STILL)[4]
    assert str({name: np.array(later[name]) for name in RANGES}) == str(drawn[4])


def test_a_collision_draws_no_new_parameters(backend: str) -> None:
    env = MaraEnv("MARACollision-v0", backend=backend, randomisation={"mass": (0.8, 1.2)})
    _, info = env.reset(seed=0)
    for _ in range(200):
        _, _, _, _, now = env.step(np.array(COLLIDING_Q, np.float32))
        if now["collided"]:
            break
    assert now["collided"]
    np.testing.assert_array_equal(env.step(STILL)[4]["mass"], info["mass"])


def test_without_ranges_nothing_is_random(backend: str) -> None:
    env = MaraEnv(backend=backend)
    env.reset(seed=0)
    first = str(_steps(env, 5))
    env.reset(seed=1)
    assert str(_steps(env, 5)) == first


def test_latency_delays_the_effect_of_an_action(backend: str) -> None:
    env = MaraEnv(backend=backend, randomisation={"latency": (0.05, 0.05)})
    env.reset(seed=0)
    moved = [np.abs(env.step(STILL + 0.5)[0][:6]).max() for _ in range(4)]
    assert moved[0] < 1e-6
    assert moved[1] < 1e-6
    np.testing.assert_allclose(
        moved[2], 0.010 * 1.57, rtol=0.1
    )  # 10 of 20 ms remain after the delay
    np.testing.assert_allclose(moved[3], 0.030 * 1.57, rtol=0.1)


def test_sensor_noise_changes_the_observation_but_not_the_reward(backend: str) -> None:
    env = MaraEnv(backend=backend, randomisation={"sensor_noise": (0.01, 0.01)})
    noiseless = MaraEnv(backend=backend)
    env.reset(seed=0)
    noiseless.reset(seed=0)
    measured = []
    for _ in range(200):
        observation, reward, _, _, info = env.step(STILL)
        _, true_reward, _, _, true_info = noiseless.step(STILL)
        assert reward == true_reward
        assert info["distance"] == true_info["distance"]
        measured.append(observation[:6])
    np.testing.assert_allclose(np.std(measured, axis=0), 0.01, rtol=0.25)


@pytest.mark.parametrize("duplicate", COPIES)
def test_a_copy_in_mid_episode_continues_identically(
    backend: str,
    duplicate: Callable[[MaraEnv], MaraEnv],
) -> None:
    env = MaraEnv("MARACollisionOrient-v0", backend=backend, randomisation=RANGES)
    env.reset(seed=0)
    _steps(env, 5)
    other = duplicate(env)
    assert str(_steps(env, 10, seed=1)) == str(_steps(other, 10, seed=1))
    assert str(env.reset()) == str(other.reset())


def test_restore_state_returns_to_a_snapshot(backend: str) -> None:
    env = MaraEnv("MARACollisionOrient-v0", backend=backend, randomisation=RANGES)
    env.reset(seed=0)
    _steps(env, 5)
    snapshot = env.save_state()
    first = str(_steps(env, 10, seed=1))
    env.reset()
    env.restore_state(snapshot)
    assert str(_steps(env, 10, seed=1)) == first


def _diverge(env: MaraEnv | MaraVectorEnv, arm: int = 0) -> None:
    """Give an arm so large a velocity that its state diverges in the next step."""
    backend = env.simulation.backend
    if isinstance(backend, DartBackend):
        backend.arms[arm].set_state(np.zeros(6), np.full(6, 1e200))
    else:
        assert isinstance(backend, MujocoBackend)
        backend._states[arm, backend._joint_v] = 1e200


def test_divergence_raises_an_error_by_default(backend: str) -> None:
    env = MaraEnv(backend=backend)
    env.reset()
    _diverge(env)
    with pytest.raises(SimulationDivergedError, match="on_divergence='truncate'"):
        env.step(STILL)


def test_divergence_can_truncate_the_episode_and_gives_no_nan(backend: str) -> None:
    env = MaraEnv("MARACollisionOrient-v0", backend=backend, on_divergence="truncate")
    env.reset()
    env.step(STILL + 0.1)
    _diverge(env)
    observation, reward, terminated, truncated, _ = env.step(STILL + 0.1)
    assert np.isfinite(observation).all()
    assert np.isfinite(reward)
    assert (terminated, truncated) == (False, True)
    env.reset()
    assert not env.step(STILL + 0.1)[3]


def test_in_a_vector_env_only_the_diverged_arm_begins_a_new_episode(
    in_one_process: dict[str, Any],
) -> None:
    envs = MaraVectorEnv(3, **in_one_process, on_divergence="truncate", autoreset_mode="SameStep")
    envs.reset()
    for _ in range(3):
        envs.step(np.full((3, 6), 0.3))
    _diverge(envs, 1)
    observation, reward, _, truncated, info = envs.step(np.full((3, 6), 0.3))
    assert truncated.tolist() == [False, True, False]
    assert np.isfinite(observation).all()
    assert np.isfinite(reward).all()
    assert np.isfinite(info["final_obs"][1]).all()
    assert (observation[1, :6] == 0.0).all()
    assert (observation[[0, 2], :6] > 0.05).all()


@pytest.mark.parametrize(("backend", "library"), [("dart", "dartpy"), ("mujoco", "mujoco")])
def test_the_error_for_a_missing_engine_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, backend: str, library: str
) -> None:
    import sys

    ours = f"gym_mara.backends.{backend}"
    for module in [name for name in sys.modules if name.startswith(ours)]:
        monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(GymMaraError, match=rf"pip install 'gym_mara\[{backend}\]'"):
        MaraEnv(backend=backend)
