"""What a deployed policy offers to other nodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import pytest

pytest.importorskip("rclpy")

from std_srvs.srv import Trigger

from gym_mara.backends import registry
from gym_mara.deploy import OnnxPolicy
from gym_mara.errors import GymMaraError
from gym_mara.pretrained import pretrained_file
from gym_mara.ros2.deploy import Deployment
from gym_mara.ros2.deploy_node import DeployNode
from gym_mara.ros2.node import RosNode
from tests.ros2.peers import Peer, eventually


@pytest.fixture
def deploy(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Deployment]]:
    """Makes deployments on arms without ROS."""
    monkeypatch.setitem(registry._BACKENDS, "ros2", "tests.ros2.fake:FakeRos2Backend")
    policy = OnnxPolicy(pretrained_file("MARAReach-v0"))
    made = []

    def make(**options: Any) -> Deployment:
        made.append(Deployment(policy, None, options, print))
        return made[-1]

    yield make
    for deployment in made:
        deployment.close()


def test_each_arm_has_services_of_its_own(deploy: Callable[..., Deployment], peer: Peer) -> None:
    arms = deploy(namespace="left"), deploy(namespace="right")
    with closing(RosNode("one")) as one, closing(RosNode("two")) as two:
        for arm, node in zip(arms, (one, two), strict=True):
            DeployNode(arm, node, print)
        assert peer.call(Trigger, "/left/gym_mara/stop").success
        status = [arm.diagnostics.status for arm in arms]
        assert status == [
            "stopped: the service /left/gym_mara/stop was called",
            "waits for a target",
        ]
        arms[1].stop("somebody asked")
        assert arms[0].backend.driver.tick() is not None  # it comes to rest
        assert arms[1].backend.driver.tick() is not None
        assert peer.call(Trigger, "/left/gym_mara/resume").success
        assert arms[0].diagnostics.status == "waits for a target"
        assert arms[1].diagnostics.status == "stopped: somebody asked"


def test_a_second_policy_with_the_same_services_does_not_start(
    deploy: Callable[..., Deployment], ros_domain: int
) -> None:
    arms = deploy(), deploy()
    with closing(RosNode("same")) as one, closing(RosNode("same")) as two:
        DeployNode(arms[0], one, print)
        eventually(lambda: two.node.count_services("/gym_mara/resume"))
        with pytest.raises(
            GymMaraError, match=r"another node serves /gym_mara/(stop|resume) already"
        ):
            DeployNode(arms[1], two, print)


@pytest.mark.parametrize("follows", [True, False])
def test_targets_are_taken_only_by_a_policy_that_follows_them(
    deploy: Callable[..., Deployment], ros_domain: int, follows: bool
) -> None:
    arm = deploy()
    arm.follows = follows
    with closing(RosNode("one")) as node:
        offered = DeployNode(arm, node, print).offered
        assert bool(node.node.get_subscriptions_info_by_topic("/gym_mara/target")) == follows
    assert ("targets on /gym_mara/target" in offered) == follows
    assert ("moves at once" in offered) != follows
