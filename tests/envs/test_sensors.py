"""Sensors: noisy positions, velocities by finite differences, and independent random generators."""

from __future__ import annotations

import numpy as np
import pytest

from gym_mara.envs import MaraEnv, MaraVectorEnv
from gym_mara.envs.sensors import Sensors, SensorSettings
from gym_mara.envs.streams import Streams
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.testing import COLLIDING_Q
from gym_mara.types import Floats

NOISE = 1e-3
PERIOD = 0.02
STILL = np.zeros(6, np.float32)


def _sensors(robot: RobotModel, velocity_filter: float = 0.0) -> Sensors:
    return Sensors(robot, 1, PERIOD, robot.velocity_limit, SensorSettings(velocity_filter))


def _measured(robot: RobotModel, velocity_filter: float, speed: float) -> Floats:
    """The measured velocities (T, J), rad/s, of an arm whose joints move at a constant speed, rad/s."""
    sensors = _sensors(robot, velocity_filter)
    env = MaraEnv()
    env.reset()
    state = env.simulation.backend.state
    noise, q = np.array([NOISE]), np.full((1, 6), -0.5)
    everyone = np.ones(1, np.bool_)
    sensors.begin_episodes((Streams.seeded(0),), everyone)
    sensors.begin(q, noise, everyone)
    rows = []
    for step in range(1, 61):
        sensors.measure(q + speed * PERIOD * step, noise)
        rows.append(sensors.seen(state).qd[0])
    return np.array(rows)


def test_a_noisy_encoder_has_a_noisy_velocity(mara: RobotModel) -> None:
    velocity = _measured(mara, 0.0, speed=0.3)
    # The standard deviation of the difference of two measurements, divided by the period.
    assert 0.7 < velocity.std() / (2**0.5 * NOISE / PERIOD) < 1.3
    np.testing.assert_allclose(velocity.mean(), 0.3, atol=0.01)


def test_the_filter_smooths_the_velocity(mara: RobotModel) -> None:
    raw, smooth = (_measured(mara, tau, speed=0.3)[30:] for tau in (0.0, 0.1))
    assert smooth.std() < 0.4 * raw.std()
    np.testing.assert_allclose(smooth.mean(), 0.3, atol=0.03)


def test_the_first_measured_velocity_is_zero(mara: RobotModel) -> None:
    env = MaraEnv(backend="dart", randomisation={"sensor_noise": (NOISE, NOISE)})
    observation, _ = env.reset(seed=0)
    parts = env.simulation.observation.split(observation)
    assert (parts["joint_positions"] != 0.0).all()
    assert not parts["tool_velocity"].any()
    parts = env.simulation.observation.split(env.step(STILL)[0])
    assert 0.0 < np.abs(parts["tool_velocity"]).max() < 1.0


def test_the_reset_after_a_collision_does_not_count_as_a_velocity() -> None:
    env = MaraEnv("MARACollision-v0", backend="dart", randomisation={"sensor_noise": (1e-6, 1e-6)})
    env.reset(seed=0)
    while not env.step(np.array(COLLIDING_Q, np.float32))[4]["collided"]:
        pass
    parts = env.simulation.observation.split(env.step(STILL)[0])
    assert np.abs(parts["tool_velocity"]).max() < 1e-3


def test_noise_and_parameters_have_independent_generators() -> None:
    both = {"sensor_noise": (NOISE, NOISE), "joint_friction": (0.0, 1.0)}
    env, other = (
        MaraEnv(backend="dart", randomisation=ranges)
        for ranges in (both, {"joint_friction": (0.0, 1.0)})
    )
    observation, info = env.reset(seed=4)
    np.testing.assert_array_equal(info["joint_friction"], other.reset(seed=4)[1]["joint_friction"])
    # With a common seed, the noise would use the same random numbers as the parameters.
    seed = Streams.seeded(4).parameters.integers(2**63)
    with_common_seed = NOISE * np.random.default_rng(seed).standard_normal(6)
    assert not np.isclose(observation[:6], with_common_seed).any()


def test_a_vector_environment_has_the_noise_of_single_environments() -> None:
    options = {"backend": "dart", "randomisation": {"sensor_noise": (NOISE, NOISE)}}
    envs = MaraVectorEnv(2, **options, velocity_filter=0.05)  # type: ignore[arg-type]
    together = [envs.reset(seed=7)[0], *(envs.step(np.full((2, 6), 0.2))[0] for _ in range(5))]
    for arm in range(2):
        env = MaraEnv(**options, velocity_filter=0.05)  # type: ignore[arg-type]
        alone = [env.reset(seed=7 + arm)[0]]
        alone += [env.step(np.full(6, 0.2, np.float32))[0] for _ in range(5)]
        np.testing.assert_allclose([o[arm] for o in together], alone, rtol=0.0, atol=1e-7)
    envs.close()


def test_a_snapshot_includes_the_sensors() -> None:
    env = MaraEnv(backend="dart", randomisation={"sensor_noise": (NOISE, NOISE)})
    env.reset(seed=0)
    env.step(STILL)
    snapshot = env.save_state()
    first = [env.step(STILL + 0.2)[0] for _ in range(4)]
    env.restore_state(snapshot)
    np.testing.assert_array_equal([env.step(STILL + 0.2)[0] for _ in range(4)], first)
    # The next episode uses the restored random generators, too.
    after = env.reset()[0]
    env.restore_state(snapshot)
    for _ in range(4):
        env.step(STILL + 0.2)
    np.testing.assert_array_equal(env.reset()[0], after)


@pytest.mark.parametrize("value", [-1.0, np.nan, "slow"])
def test_an_invalid_filter_is_refused(value: object) -> None:
    with pytest.raises(GymMaraError, match="velocity_filter must be finite and not negative"):
        MaraEnv(velocity_filter=value)


def test_a_backend_switch_has_its_own_random_generator() -> None:
    drawn = []
    for _ in range(2):
        env = MaraEnv(backend="dart", randomisation={"mass": (0.5, 1.5)})
        env.reset(seed=1)
        env.simulation.switch_backend("dart")
        parameters = env.simulation.backend.state.parameters
        assert parameters is not None
        drawn.append(parameters["mass"])
        after = env.reset()[1]["mass"]
        plain = MaraEnv(backend="dart", randomisation={"mass": (0.5, 1.5)})
        plain.reset(seed=1)
        np.testing.assert_array_equal(after, plain.reset()[1]["mass"])
    np.testing.assert_array_equal(drawn[0], drawn[1])


def test_a_filter_without_noise_is_refused() -> None:
    for options in ({}, {"backend": "dart", "randomisation": {"mass": (0.9, 1.1)}}):
        with pytest.raises(GymMaraError, match="velocity_filter smooths the velocity of noisy"):
            MaraEnv(velocity_filter=0.1, **options)  # type: ignore[arg-type]
