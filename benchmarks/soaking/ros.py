"""Scenarios of ROS 2: an environment, a deployed policy and bags, with one simulated arm in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from gym_mara.deploy import OnnxPolicy
from gym_mara.identification import Log
from gym_mara.pretrained import pretrained_file
from gym_mara.robot import RobotModel
from gym_mara.ros2.bags.bag import Bag
from gym_mara.ros2.bags.logs import STATES, read_log, write_episode
from gym_mara.ros2.bags.recording import record
from gym_mara.ros2.deploy import Deployment, Target
from gym_mara.ros2.driver import ArmStoppedError
from soaking.environments import step
from soaking.tally import Scenario, Tally

ENV = "MARAReach-v0"
SECONDS = 1.0
"""How long each scenario moves the arm, or records it."""
_PERIOD = 0.02
_TARGETS = Target((-0.4, 0.095, 0.87)), Target((-0.3, 0.4, 0.9))


@contextmanager
def simulated_arm() -> Iterator[None]:
    """A simulated MARA as a process, in a ROS domain of this machine alone."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 101)
    command = [sys.executable, "-m", "gym_mara.cli", "ros2", "sim", "--backend", "mujoco"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            if not line.startswith("ready"):
                raise SystemExit(f"the simulated arm did not start: {line}")
            yield
        finally:
            process.terminate()


def live(seed: int, tally: Tally) -> None:
    """Moves the arm as an environment, from its home pose on."""
    env: Any = gymnasium.make(f"gym_mara/{ENV}", backend="ros2", live=True)
    with closing(env):
        home = env.unwrapped.simulation.robot.home.tolist()
        env.action_space.seed(seed)
        try:
            env.reset(seed=seed, options={"start_q": home})
            for _ in range(round(SECONDS / _PERIOD)):
                step(env, env.action_space.sample(), tally)
        except ArmStoppedError as error:
            tally.done["stops"] += 1
            print(f"round {seed + 1}: {error}", file=sys.stderr, flush=True)


def deployment(seed: int, tally: Tally, *, policy: OnnxPolicy) -> None:
    """Lets a policy move the arm towards a target."""
    with closing(Deployment(policy, None, {"live": True}, lambda line: None)) as deployed:
        deployed.aim(_TARGETS[seed % 2]).result()
        deployed.run(SECONDS)
        found = deployed.diagnostics
    tally.done["steps"] += found.steps
    tally.done["stops"] += int(found.status.startswith("stopped"))
    tally.wrong["no answer"] += int(found.steps == 0)
    tally.wrong["NaN"] += int(not np.isfinite(found.setpoint).all())


def bags(seed: int, tally: Tally, *, robot: RobotModel) -> None:
    """Records the arm's topics and reads them back; and writes a log into a bag and reads it back."""
    with tempfile.TemporaryDirectory() as folder:
        counts = record(Path(folder, "recorded"), (STATES,), SECONDS)
        with Bag(Path(folder, "recorded")) as bag:
            read = [message.value.position for message in bag.messages((STATES,))]
        tally.wrong["no answer"] += int(not read)
        tally.wrong["NaN"] += int(not np.isfinite(read).all())
        tally.compare(counts, {STATES: len(read)})
        generator = np.random.default_rng(seed)
        shape = (3, 200, robot.num_joints)
        targets, q, qd = generator.uniform(robot.lower, robot.upper, shape)
        log = Log(np.arange(200) * np.float64(_PERIOD), targets, q, qd, robot.joint_names)
        write_episode(Path(folder, "written"), log, robot)
        back = read_log(Path(folder, "written"), robot)
        tally.compare([targets, q, qd], [back.targets, back.q, back.qd])
        tally.done["files"] += 2
        tally.wrong["left files"] += int(len([*Path(folder).iterdir()]) != 2)


def scenarios() -> dict[str, Scenario]:
    """Name → scenario, for an arm as of `simulated_arm`."""
    policy, robot = OnnxPolicy(pretrained_file(ENV)), RobotModel.load("mara")
    return {
        "ros2, an environment": live,
        "ros2, a deployed policy": partial(deployment, policy=policy),
        "ros2, bags": partial(bags, robot=robot),
    }
