"""The backend "ros2" with an arm without ROS and a clock that the test moves."""

from __future__ import annotations

import copy
import gc
import itertools
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest

from gym_mara.backends import backend_names, make_backend, registry, simulated_backends
from gym_mara.envs import make_vector_env
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.ros2.arm import ArmState, Clock, Link, WallClock
from gym_mara.ros2.driver import ArmStoppedError
from tests.helpers import PATH_ENDS
from tests.ros2.fake import FakeArm, FakeClock, FakeRos2Backend

Make = Callable[..., FakeRos2Backend]


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return RobotModel.load("mara")


@pytest.fixture
def make(robot: RobotModel) -> Make:
    def made(**settings: Any) -> FakeRos2Backend:
        backend = FakeRos2Backend(robot, 1, **{"live": True, **settings})
        backend.reset(backend.state.q)
        return backend

    return made


def _steps(backend: FakeRos2Backend, count: int) -> None:
    for _ in range(count):
        backend.step(backend.arm.q[None] + 0.3)


def test_a_step_moves_the_arm_towards_the_target_for_a_control_period(make: Make) -> None:
    backend = make()
    target = backend.state.q + 0.1
    before = backend.clock.now()
    states = [backend.step(target) for _ in range(100)]
    assert backend.clock.now() - before == pytest.approx(100 * backend.control_period)
    np.testing.assert_allclose(states[-1].q, target, atol=1e-9)
    assert states[-1].time == pytest.approx(2.0)
    moved = [float(state.q[0, 0]) for state in states]
    assert all(a <= b for a, b in itertools.pairwise(moved))


def test_the_state_is_that_of_the_arm(make: Make, robot: RobotModel) -> None:
    backend = make()
    state = backend.step(backend.state.q + 0.05)
    np.testing.assert_array_equal(state.q[0], backend.arm.q)
    position, quaternion = robot.kinematics().pose(state.q)
    np.testing.assert_array_equal(state.ee_position, position)
    np.testing.assert_array_equal(state.ee_quaternion, quaternion)
    assert not state.collided[0]
    assert set(state.timing or {}) == {"lateness", "missed_ticks", "state_age"}


def test_late_actions_are_reported_and_missed_periods_are_left_out(make: Make) -> None:
    backend = make(command_age=10.0)
    backend.step(backend.state.q)
    backend.clock.pass_by(0.005)
    timing = backend.step(backend.state.q).timing
    assert timing is not None
    assert timing["lateness"][0] == pytest.approx(0.005)
    assert timing["missed_ticks"][0] == 0
    backend.clock.pass_by(0.05)
    before = backend.clock.now()
    timing = backend.step(backend.state.q).timing
    assert timing is not None
    assert timing["missed_ticks"][0] == 2
    assert backend.clock.now() - before <= backend.control_period + 1e-9


def test_reset_moves_slowly_to_the_start_pose_and_ends_at_rest(make: Make) -> None:
    backend = make()
    start = backend.state.q + 0.5
    backend.reset(start)
    state = backend.state
    np.testing.assert_allclose(state.q, start, atol=0.011)
    assert np.abs(state.qd).max() < 0.06
    speeds = np.array([s.qd for s in backend.arm.sent])
    assert (np.abs(speeds) <= 0.25 * backend.joint_velocity + 1e-6).all()
    assert state.time[0] == 0.0


@pytest.mark.parametrize("fastest", [None, 0.05])
def test_a_reset_takes_as_long_as_its_way_at_a_low_speed(make: Make, fastest: float | None) -> None:
    backend = make(max_joint_velocity=fastest, max_joint_acceleration=1.0)
    before = backend.clock.now()
    backend.reset(backend.state.q + np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.5]))
    least = 1.0 / (0.25 * backend.joint_velocity[0])
    assert abs(backend.clock.now() - before - least) < 2.0
    if fastest:
        assert least > 60.0


def test_an_arm_that_does_not_arrive_is_an_error_soon(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    backend = make(tracking_error=10.0)
    backend.arm.follows = False
    before = backend.clock.now()
    with pytest.raises(GymMaraError, match=r"within .* s: joint motor1 is 0\.2 rad"):
        backend.reset(backend.state.q + 0.2)
    assert 5.0 < backend.clock.now() - before < 8.0
    assert "interrupted" in (backend.driver.safety.reason or "")


def test_reset_refuses_a_start_pose_behind_an_obstacle(robot: RobotModel) -> None:
    class There(FakeRos2Backend):
        start_q = np.array(PATH_ENDS[0])

    backend = There(robot, 1, live=True)
    sent = len(backend.arm.sent)
    with pytest.raises(GymMaraError, match=r"straight joint move from .* collides"):
        backend.reset(np.array([PATH_ENDS[1]]))
    assert len(backend.arm.sent) == sent, "nothing moves"


def test_a_collision_ahead_stops_the_arm_and_the_next_reset_resumes_it(robot: RobotModel) -> None:
    class There(FakeRos2Backend):
        start_q = np.array(PATH_ENDS[0])

    backend = There(robot, 1, live=True)
    backend.reset(backend.state.q)
    state = backend.state
    for _ in range(1000):
        state = backend.step(np.array([PATH_ENDS[1]]))
        if state.collided[0]:
            break
    assert state.collided[0]
    before = backend.clock.now()
    backend.step(np.array([PATH_ENDS[1]]))
    assert backend.clock.now() == pytest.approx(before + backend.control_period), "in its time"
    assert not backend._checker.check(backend.state.q)[0], "it stops before the obstacle"
    backend.reset(backend.state.q)
    assert not backend.state.collided[0]
    backend.step(np.array([PATH_ENDS[0]]))


@pytest.mark.parametrize("on_collision", ["reset", "terminate"])
def test_an_environment_goes_on_after_a_collision_ahead(
    on_collision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(registry._BACKENDS, "ros2", "tests.ros2.fake:FakeRos2Backend")
    keywords = {"live": True, "on_collision": on_collision, "command_age": 5.0, "backend": "ros2"}
    envs = make_vector_env("MARA-v0", 1, start_q=PATH_ENDS[0], **keywords)
    envs.reset(seed=0)
    collisions = 0
    for _ in range(600):
        *_, infos = envs.step(np.array([PATH_ENDS[1]], np.float32))
        collisions += int(infos["collided"][0])
    assert collisions >= 2
    envs.close()


def test_a_reset_never_ends_the_stop_of_an_operator(robot: RobotModel) -> None:
    class There(FakeRos2Backend):
        start_q = np.array(PATH_ENDS[0])

    backend = There(robot, 1, live=True)
    backend.reset(backend.state.q)
    while not backend.state.collided[0]:
        backend.step(np.array([PATH_ENDS[1]]))
    backend.driver.stop("the operator's wish")
    with pytest.raises(ArmStoppedError, match="the operator's wish"):
        backend.reset(backend.state.q)
    backend.clock.pass_by(1.0)
    with pytest.raises(ArmStoppedError, match="the operator's wish"):
        backend.reset(backend.state.q)


def test_an_arm_that_rests_is_told_nothing_and_can_be_moved_by_hand(make: Make) -> None:
    backend = make()
    backend.clock.pass_by(1.0)
    assert not backend.arm.sent, "nothing before the first action"
    _steps(backend, 20)
    backend.driver.stop("somebody moves it by hand")
    backend.clock.pass_by(1.0)
    backend.arm.sent.clear()
    backend.arm.q = backend.arm.q + 0.5
    backend.arm.qd[:] = 0.0
    backend.clock.pass_by(5.0)
    assert not backend.arm.sent, "nothing after a stop"
    backend.driver.resume()
    backend.reset(backend.state.q)
    q = backend.state.q
    state = backend.step(q)
    np.testing.assert_allclose(state.q, q, atol=1e-9)


@pytest.mark.parametrize("live", [True, False])
def test_an_arm_that_was_moved_before_the_first_command_starts_where_it_is(
    make: Make, live: bool
) -> None:
    backend = make(live=live)
    backend.clock.pass_by(1.0)
    backend.arm.q = moved = backend.arm.q + 0.18
    backend.driver.command(moved + 0.1)
    backend.clock.pass_by(backend.driver.safety.period)
    setpoint = backend.driver.setpoint
    assert setpoint is not None
    np.testing.assert_allclose(setpoint.q, moved, atol=1e-3)


def test_a_reset_that_is_interrupted_stops_the_arm(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    backend = make()
    ends = backend.clock.now() + 0.5

    def interrupted(instant: float) -> None:
        if instant > ends:
            raise KeyboardInterrupt
        FakeClock.sleep_until(backend.clock, instant)

    monkeypatch.setattr(backend.clock, "sleep_until", interrupted)
    with pytest.raises(KeyboardInterrupt):
        backend.reset(backend.state.q + 1.0)
    monkeypatch.undo()
    backend.arm.sent.clear()
    backend.clock.pass_by(2.0)
    speeds = np.abs([sent.qd for sent in backend.arm.sent])
    assert speeds.max() <= 0.25 * backend.joint_velocity.max() + 1e-6, "never faster than before"
    assert not speeds[-1].any()
    assert "interrupted" in (backend.driver.safety.reason or "")


def test_closing_a_moving_arm_brings_it_to_rest(robot: RobotModel) -> None:
    class InThread(FakeRos2Backend):
        _in_thread = True

        def _connect(self, profile: str, **options: Any) -> tuple[Link, Clock]:
            arm, _ = super()._connect(profile, **options)
            clock = WallClock()
            assert isinstance(arm, FakeArm)
            arm.clock = clock  # type: ignore[assignment]
            return arm, clock

    backend = InThread(robot, 1, live=True, max_joint_acceleration=2.0)
    backend.reset(backend.state.q)
    _steps(backend, 20)
    assert np.abs(backend.arm.qd).max() > 0.1
    assert gc.get_freeze_count() > 10_000, "a garbage collection would take long"
    backend.close()
    assert gc.get_freeze_count() == 0
    assert not backend.arm.qd.any()
    assert backend.arm.closed
    backend.close()


def test_an_arm_that_falls_silent_stops_and_steps_say_why_until_it_is_resumed(make: Make) -> None:
    backend = make()
    backend.arm.silent_since = backend.clock.now()
    with pytest.raises(ArmStoppedError, match=r"state is .* old.*resume"):
        _steps(backend, 20)
    with pytest.raises(ArmStoppedError):
        backend.reset(backend.state.q)
    backend.arm.silent_since = None
    backend.clock.pass_by(1.0)
    backend.driver.resume()
    backend.reset(backend.state.q)
    backend.step(backend.state.q)


def test_an_arm_that_does_not_follow_stops(make: Make) -> None:
    backend = make()
    backend.arm.follows = False
    with pytest.raises(ArmStoppedError, match="does not follow"):
        _steps(backend, 100)


def test_an_arm_with_noisy_encoders_starts_and_arrives(
    robot: RobotModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    noise = np.random.default_rng(0)

    def noisy(arm: FakeArm) -> ArmState:
        qd = arm.qd + noise.uniform(-0.09, 0.09, len(arm.qd))
        return ArmState(arm.q.copy(), qd, None, arm.clock.now(), arm.clock.now())

    monkeypatch.setattr(FakeArm, "state", property(noisy))
    with pytest.raises(GymMaraError, match="rest_velocity"):
        FakeRos2Backend(robot, 1, live=True)
    backend = FakeRos2Backend(robot, 1, live=True, rest_velocity=0.1)
    before = backend.clock.now()
    backend.reset(backend.state.q + 0.2)
    assert backend.clock.now() - before < 2.0


@pytest.mark.parametrize(
    ("settings", "speed", "in_points"),
    [
        ({"profile": "mara-2019"}, 0.5, 0.5),
        ({"profile": "mara-2019", "max_joint_velocity": 0.3}, 0.3, 0.3),
        ({"profile": "mara-2019", "max_joint_velocity": 9.0}, 1.57, 1.57),
        ({}, 1.57, None),
    ],
)
def test_the_servos_of_2019_are_commanded_no_faster_than_their_points_say(
    robot: RobotModel, settings: dict[str, Any], speed: float, in_points: float | None
) -> None:
    class Noted(FakeRos2Backend):
        def _connect(self, profile: str, **options: Any) -> tuple[Link, Clock]:
            assert options["velocity"] == in_points
            return super()._connect(profile, **options)

    backend = Noted(robot, 1, live=True, **settings)
    backend.reset(backend.state.q)
    for _ in range(100):
        backend.step(backend.state.q + 1.0)
    assert np.abs([sent.qd for sent in backend.arm.sent]).max() == pytest.approx(speed)


def test_a_learner_that_pauses_leaves_the_arm_at_rest_at_its_last_target(make: Make) -> None:
    backend = make(command_age=2.0)
    target = backend.state.q + 0.1
    backend.step(target)
    backend.clock.pass_by(30.0)
    state = backend.step(target)
    np.testing.assert_allclose(state.q, target, atol=1e-9)


def test_without_live_nothing_is_sent_and_the_arm_stays(make: Make) -> None:
    backend = make(live=False)
    q = backend.state.q
    backend.reset(q + 0.5)
    for _ in range(50):
        state = backend.step(q + 0.5)
    assert not backend.arm.sent
    np.testing.assert_array_equal(state.q, q)
    planned = backend.driver.setpoint
    assert planned is not None
    assert np.abs(planned.q - q[0]).max() > 0.1, "what would be sent"


def test_it_cannot_be_saved_restored_or_copied(make: Make) -> None:
    backend = make()
    with pytest.raises(GymMaraError, match="real arm"):
        backend.save()
    with pytest.raises(GymMaraError, match="real arm"):
        backend.restore({})
    with pytest.raises(GymMaraError, match="real arm"):
        copy.deepcopy(backend)


def test_it_moves_one_arm(robot: RobotModel) -> None:
    with pytest.raises(GymMaraError, match="num_envs must be at most 1"):
        make_backend("ros2", robot, 2, {})


def test_it_is_a_backend_but_no_simulated_one() -> None:
    assert "ros2" in backend_names()
    assert "ros2" not in simulated_backends()


def test_the_id_of_a_real_arm_has_this_backend() -> None:
    spec = gymnasium.spec("gym_mara/MARAReal-v0")
    assert spec.kwargs == {"task": "MARA-v0", "backend": "ros2"}
