"""A policy on an arm without ROS, with a clock that the test moves."""

from __future__ import annotations

import dataclasses
import gc
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from gym_mara.backends import registry
from gym_mara.deploy import OnnxPolicy
from gym_mara.envs import make_vector_env
from gym_mara.errors import GymMaraError
from gym_mara.pretrained import pretrained_file
from gym_mara.ros2.deploy import Deployment, Target
from tests.helpers import Cli
from tests.ros2.fake import FakeArm, FakeClock, FakeRos2Backend, LateArm

NEAR, OTHER = Target((-0.4, 0.095, 0.87)), Target((-0.3, 0.4, 0.9))
AWAY = Target((5.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def policy() -> OnnxPolicy:
    return OnnxPolicy(pretrained_file("MARAReach-v0"))


@pytest.fixture
def deploy(
    policy: OnnxPolicy, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., Deployment]]:
    monkeypatch.setitem(registry._BACKENDS, "ros2", "tests.ros2.fake:FakeRos2Backend")
    made = []

    def make(log: Callable[[str], None] = print, **options: Any) -> Deployment:
        made.append(Deployment(policy, None, {"live": True, **options}, log))
        return made[-1]

    yield make
    for deployment in made:
        deployment.close()


def _arm(deployment: Deployment) -> FakeArm:
    arm = deployment.backend.driver.link
    assert isinstance(arm, FakeArm)
    return arm


def _clock(deployment: Deployment) -> FakeClock:
    clock = deployment.backend.clock
    assert isinstance(clock, FakeClock)
    return clock


def _error(deployment: Deployment, target: Target) -> float:
    """The tool's distance to a target, m."""
    return float(np.linalg.norm(deployment.backend.state.ee_position - target.position))


def test_it_reaches_a_target_and_follows_the_next_one(deploy: Callable[..., Deployment]) -> None:
    deployment = deploy()
    for target in (NEAR, OTHER, NEAR):
        deployment.aim(target).result()
        deployment.run(8.0)
        assert _error(deployment, target) < 1e-4
        assert deployment.diagnostics.error == pytest.approx(_error(deployment, target), abs=1e-6)
    assert deployment.diagnostics.status == "has reached -0.400, 0.095, 0.870 m"


def test_it_comes_to_rest_at_targets_around_which_a_late_arm_would_swing(
    deploy: Callable[..., Deployment], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FakeRos2Backend, "arm_class", LateArm)
    deployment = deploy()
    for target in (Target((0.694, -0.231, 1.060)), Target((-0.165, 0.138, 1.682))):
        deployment.aim(target).result()
        deployment.run(8.0)
        assert _error(deployment, target) < 1e-4


def test_without_a_target_the_arm_rests(deploy: Callable[..., Deployment]) -> None:
    deployment = deploy()
    q = _arm(deployment).q.copy()
    deployment.run(3.0)
    np.testing.assert_array_equal(_arm(deployment).q, q)
    assert deployment.diagnostics.status == "waits for a target"


def test_a_target_out_of_reach_is_refused_and_the_last_one_stays(
    deploy: Callable[..., Deployment],
) -> None:
    notes: list[str] = []
    deployment = deploy(notes.append)
    q = _arm(deployment).q.copy()
    with pytest.raises(GymMaraError, match="reach"):
        deployment.check(AWAY)
    deployment.aim(AWAY).result()
    deployment.run(2.0)
    np.testing.assert_array_equal(_arm(deployment).q, q)
    assert sum("target refused" in note for note in notes) == 1
    deployment.aim(NEAR).result()
    deployment.run(6.0)
    deployment.aim(AWAY).result()
    deployment.run(1.0)
    assert _error(deployment, NEAR) < 1e-4
    assert sum("target refused" in note for note in notes) == 2


def test_a_stop_is_latched_until_the_operator_resumes(deploy: Callable[..., Deployment]) -> None:
    notes: list[str] = []
    deployment = deploy(notes.append)
    deployment.aim(NEAR).result()
    deployment.run(0.7)
    deployment.stop("somebody asked")
    deployment.run(2.0)
    stopped = _arm(deployment).q.copy()
    assert deployment.diagnostics.status == "stopped: somebody asked"
    deployment.run(5.0)
    np.testing.assert_array_equal(_arm(deployment).q, stopped)
    assert _error(deployment, NEAR) > 0.01
    deployment.aim(NEAR).result()
    assert notes[-1] == "the target is kept: the arm moves to it once /gym_mara/resume is called"
    deployment.resume()
    deployment.run(8.0)
    assert _error(deployment, NEAR) < 1e-4
    assert "stopped: somebody asked; call /gym_mara/resume to go on" in notes


def test_a_stop_is_seen_while_it_waits_for_a_target(deploy: Callable[..., Deployment]) -> None:
    notes: list[str] = []
    deployment = deploy(notes.append)
    deployment.run(1.0)
    deployment.stop("somebody asked")
    deployment.run(1.0)
    found = deployment.diagnostics
    assert (found.status, found.in_trouble) == ("stopped: somebody asked", True)
    assert "stopped: somebody asked; call /gym_mara/resume to go on" in notes
    deployment.resume()
    deployment.aim(NEAR).result()
    deployment.run(8.0)
    assert _error(deployment, NEAR) < 1e-4


def test_after_a_collision_ahead_the_operator_resumes(
    deploy: Callable[..., Deployment], monkeypatch: pytest.MonkeyPatch
) -> None:
    deployment = deploy()
    paths = deployment.backend.driver.safety._paths
    deployment.aim(NEAR).result()
    deployment.run(0.7)
    with monkeypatch.context() as patch:
        patch.setattr(paths, "first_collision", lambda motion: _arm(deployment).q)
        deployment.run(0.5)
    assert deployment.diagnostics.status.startswith("stopped: collision ahead")
    stopped = _arm(deployment).q.copy()
    deployment.run(3.0)
    np.testing.assert_array_equal(_arm(deployment).q, stopped)
    deployment.resume()
    deployment.run(8.0)
    assert _error(deployment, NEAR) < 1e-4


def test_no_setting_resumes_an_arm_after_a_collision_ahead(
    deploy: Callable[..., Deployment], policy: OnnxPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    for setting in ("reset", "terminate", "continue"):
        with pytest.raises(GymMaraError, match="on_collision cannot be set"):
            deploy(on_collision=setting)
    trained = {**policy.about.training.env_options, "on_collision": "reset"}
    monkeypatch.setattr(
        policy,
        "about",
        dataclasses.replace(
            policy.about,
            training=dataclasses.replace(policy.about.training, env_options=trained),
        ),
    )
    assert deploy().simulation.task.on_collision == "continue"


def test_an_arm_that_falls_silent_is_told_while_it_rests(deploy: Callable[..., Deployment]) -> None:
    notes: list[str] = []
    deployment = deploy(notes.append)
    deployment.run(0.5)
    assert notes == ["waits for a target"]
    _arm(deployment).silent_since = _clock(deployment).now()
    deployment.run(2.0)
    assert deployment.diagnostics.in_trouble
    assert notes[1:] == ["hears nothing from the arm"], "once"


def test_an_arm_that_falls_silent_stops_where_it_is(deploy: Callable[..., Deployment]) -> None:
    deployment = deploy()
    deployment.aim(NEAR).result()
    deployment.run(0.7)
    arm = _arm(deployment)
    arm.silent_since = _clock(deployment).now()
    deployment.run(2.0)
    assert "old" in deployment.diagnostics.status
    with pytest.raises(GymMaraError, match="old"):
        deployment.resume()
    arm.silent_since = None
    deployment.resume()
    deployment.run(8.0)
    assert _error(deployment, NEAR) < 1e-4


def test_without_live_nothing_is_sent(deploy: Callable[..., Deployment]) -> None:
    notes: list[str] = []
    deployment = deploy(notes.append, live=False)
    deployment.aim(NEAR).result()
    deployment.run(2.5)
    assert not _arm(deployment).sent
    told = [note for note in notes if note.startswith("would send: ")]
    assert len(told) == 2, "once a second"


def test_an_end_is_an_end(deploy: Callable[..., Deployment]) -> None:
    deployment = deploy()
    deployment.end()
    deployment.run()


@pytest.mark.parametrize("how", ["end", "seconds"])
def test_an_end_is_one_on_the_way_back_to_the_start_too(
    deploy: Callable[..., Deployment], monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    deployment = deploy(max_joint_velocity=0.2)
    simulation = deployment.simulation
    simulation.task = dataclasses.replace(simulation.task, on_collision="reset")
    clock, start = _clock(deployment), _arm(deployment).q.copy()
    deployment.aim(NEAR).result()
    began, wait, collisions = clock.time, clock.sleep_until, [start]

    def ahead(_: object) -> Any:
        return collisions.pop() if clock.time > began + 4.0 and collisions else None

    def sleep_until(instant: float) -> None:
        wait(instant)
        if how == "end" and clock.time > began + 6.0:
            deployment.end()

    monkeypatch.setattr(deployment.backend.driver.safety._paths, "first_collision", ahead)
    monkeypatch.setattr(clock, "sleep_until", sleep_until)
    deployment.run(6.0 if how == "seconds" else None)
    assert began + 6.0 <= clock.time < began + 6.1
    assert deployment.diagnostics.status == "stopped: the motion to the start pose was interrupted"
    assert np.abs(_arm(deployment).q - start).max() > 0.05, "it was on its way"


def test_a_policy_of_another_robot_is_refused(deploy: Callable[..., Deployment]) -> None:
    with pytest.raises(GymMaraError, match=r"another|moves the joints"):
        deploy(robot="ur5")


def test_a_policy_with_a_target_of_its_own_takes_no_other(
    deploy: Callable[..., Deployment],
) -> None:
    deployment = deploy()
    deployment.follows = False
    with pytest.raises(GymMaraError, match="own"):
        deployment.aim(NEAR)


@pytest.mark.parametrize("name", ["live", "profile", "domain"])
def test_set_does_not_move_the_arm_in_a_dry_run(gym_mara: Cli, name: str) -> None:
    code, _, error = gym_mara("ros2", "deploy", "policy.onnx", "--set", f"{name}=true")
    assert code == 2
    assert f"--set {name} has no effect here: give --{name}" in error


def test_what_was_spared_from_garbage_collections_is_freed_at_the_end(
    deploy: Callable[..., Deployment],
) -> None:
    deployment = deploy()
    assert gc.get_freeze_count() > 0
    deployment.close()
    assert gc.get_freeze_count() == 0


def test_an_environment_that_cannot_be_made_leaves_no_arm_driven(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(registry._BACKENDS, "ros2", "tests.ros2.fake:FakeRos2Backend")
    closed: list[FakeRos2Backend] = []
    monkeypatch.setattr(FakeRos2Backend, "close", lambda backend: closed.append(backend))
    with pytest.raises(GymMaraError, match="action_scale"):
        make_vector_env("MARAReach-v0", 1, backend="ros2", live=True, action_scale=[0.1, 0.1])
    assert len(closed) == 1
