"""Logs and episodes from bags, and back."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gym_mara.envs.simulation import Simulation
from gym_mara.errors import GymMaraError, positive_number
from gym_mara.identification.log import Log
from gym_mara.robot import RobotModel
from gym_mara.ros2.bags.bag import Bag, Message, Recorder
from gym_mara.types import Floats

if TYPE_CHECKING:
    from gym_mara.envs import MaraEnv

STATES = "/joint_states"
COMMANDS = "/joint_trajectory_controller/joint_trajectory"
STATE_TYPE = "sensor_msgs/msg/JointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
ARRAY = "std_msgs/msg/Float64MultiArray"
_MOST = 10_000_000
"""The most messages of a topic that are read, and the most ticks."""


def read_log(
    path: Path,
    robot: RobotModel,
    period: float = 0.02,
    *,
    states: str = STATES,
    commands: str | None = None,
) -> Log:
    """The log of an arm from a bag: at each tick the last joint state and the last joint targets until then.

    Joints are found by their names, in any order and among others. Messages that lack a joint, or in which a position is not
    finite, are left out. Commands are a JointTrajectory, of which the last point counts, or a Float64MultiArray, in the
    robot's order of joints. Where states have no velocities they are differences of positions.

    Args:
        path: the bag.
        robot: the arm.
        period: the control period of the log, s.
        states: the topic of the joint states.
        commands: the topic of the commands; None for the only one in the bag.

    Raises:
        DamagedFileError: the bag is missing or damaged.
        GymMaraError: it lacks joint states, commands or joints, or is too short.
        MissingExtraError: `rosbags` is not installed.
    """
    period = positive_number("period", period, "s", at_least=1e-4, at_most=10.0)
    with Bag(path) as bag:
        if bag.topics.get(states) != STATE_TYPE:
            raise _lacks(path, f"joint states on {states}", bag)
        topic = _command_topic(path, bag) if commands is None else commands
        if bag.topics.get(topic) not in (TRAJECTORY, ARRAY):
            raise _lacks(path, f"commands on {topic}", bag)
        found: dict[str, list[tuple[int, Floats]]] = {states: [], topic: []}
        columns = _Columns(robot.joint_names)
        for message in bag.messages((states, topic)):
            row = columns.row(message)
            if row is not None:
                found[message.topic].append((message.time, row))
            if len(found[message.topic]) > _MOST:
                raise GymMaraError(
                    f"{str(path)!r} has more than {_MOST:,} messages of a topic: cut it"
                )
    for name, rows in found.items():
        if not rows:
            raise GymMaraError(
                f"{str(path)!r} has no complete message on {name}: it must have finite values of {', '.join(robot.joint_names)}"
                f"{columns.told(name)}"
            )
    return _resampled(found[states], found[topic], robot, period)


def _command_topic(path: Path, bag: Bag) -> str:
    for kind in (TRAJECTORY, ARRAY):
        topics = [topic for topic, its in bag.topics.items() if its == kind]
        if len(topics) > 1:
            raise GymMaraError(
                f"{str(path)!r} has several topics of commands: name one of {', '.join(sorted(topics))}"
            )
        if topics:
            return topics[0]
    raise _lacks(path, "commands, JointTrajectory or Float64MultiArray", bag)


def _lacks(path: Path, what: str, bag: Bag) -> GymMaraError:
    topics = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(bag.topics.items()))
    return GymMaraError(f"{str(path)!r} has no {what}; its topics are: {topics or 'none'}")


class _Columns:
    """Puts the values of messages in the robot's order of joints."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = list(names)
        self._seen: dict[str, list[str]] = {}

    def told(self, topic: str) -> str:
        """The joints of the last message of a topic, for an error."""
        seen = self._seen.get(topic)
        return "" if seen is None else f"; its messages have {', '.join(seen[:20]) or 'no joints'}"

    def row(self, message: Message) -> Floats | None:
        """Positions, and for a state velocities (2 J,), NaN where there are none; None for a message that is refused."""
        value, count = message.value, len(self._names)
        if message.kind == ARRAY:
            values = np.asarray(value.data, np.float64)
            return values if len(values) == count and np.isfinite(values).all() else None
        if message.kind == TRAJECTORY:
            names = value.joint_names
            positions = value.points[-1].positions if len(value.points) else np.zeros(0)
            velocities = None
        else:
            names, positions, velocities = value.name, value.position, value.velocity
        self._seen[message.topic] = list(names)
        place = {name: index for index, name in enumerate(names)}
        if len(positions) != len(names) or any(name not in place for name in self._names):
            return None
        own = [place[name] for name in self._names]
        row = np.asarray(positions, np.float64)[own]
        if not np.isfinite(row).all():
            return None
        if message.kind == TRAJECTORY:
            return row
        speed = np.full(count, np.nan)
        if velocities is not None and len(velocities) == len(names):
            speed = np.asarray(velocities, np.float64)[own]
        return np.concatenate([row, speed])


def _resampled(
    states: list[tuple[int, Floats]],
    commands: list[tuple[int, Floats]],
    robot: RobotModel,
    period: float,
) -> Log:
    """The last values known at each tick."""
    state_times = np.array([stamp for stamp, _ in states], np.int64)
    command_times = np.array([stamp for stamp, _ in commands], np.int64)
    begin, end = max(state_times[0], command_times[0]), state_times[-1]
    step = round(period * 1e9)
    count = int((end - begin) // step) + 1 if end >= begin else 0
    if count > _MOST:
        raise GymMaraError(
            f"the bag has {count:,} control periods, and at most {_MOST:,} are read: cut it"
        )
    ticks = begin + step * np.arange(count, dtype=np.int64)
    rows = np.array([row for _, row in states])[np.searchsorted(state_times, ticks, "right") - 1]
    targets = np.array([row for _, row in commands])
    held = targets[np.searchsorted(command_times, ticks, "right") - 1]
    q, qd = np.split(rows, 2, axis=1)
    if count > 1 and not np.isfinite(qd).all():
        qd = np.gradient(q, period, axis=0)
    times = 1e-9 * (ticks - begin)
    return Log(times, held, q.copy(), qd, robot.joint_names)


@dataclass(frozen=True, eq=False)
class Episode:
    """What an environment says of a log: T ticks, and an action between any two of them."""

    observation: Floats
    """(T, O)."""
    action: Floats
    """Joint targets in the action space (T - 1, J), rad (m)."""
    reward: Floats
    """Of the states that follow the actions (T - 1,)."""


def episode(log: Log, env: MaraEnv) -> Episode:
    """The observations, actions and rewards of an environment on the states of a log.

    The goal is that of the environment's last reset. Nothing moves: the environment must be reset before its next step.

    Raises:
        GymMaraError: the log is of another arm, or the actions of the environment are not joint targets.
    """
    simulation: Simulation = env.simulation
    log.require(simulation.robot.joint_names, simulation.robot.name)
    if simulation.actions.mode != "absolute":
        raise GymMaraError(
            f"a log has joint targets, and the actions of this environment are {simulation.actions.mode}: make it with "
            "action='absolute'"
        )
    simulation.actions.begin(log.q[:1], None)
    observations, rewards, actions = [], [], []
    for tick in range(len(log.times)):
        if tick:
            simulation.actions.targets(log.targets[tick - 1 : tick])
            actions.append(simulation.actions.action[0])
        state = _state(simulation, log.q[tick : tick + 1], log.qd[tick : tick + 1], log.times[tick])
        observations.append(simulation.observation(state, simulation.goal)[0])
        if tick:
            rewards.append(simulation.rewards(state)[0][0])
    return Episode(np.array(observations), np.array(actions), np.array(rewards))


def _state(simulation: Simulation, q: Floats, qd: Floats, time: float) -> Any:
    """The state of an arm at q with velocities qd, both (1, J)."""
    inside = q.clip(simulation.robot.lower, simulation.robot.upper)
    simulation.backend.reset(inside)
    kinematics = simulation.robot.kinematics()
    position, quaternion, velocity = kinematics.motion(q, qd)
    state = dataclasses.replace(
        simulation.backend.state,
        q=q,
        qd=qd,
        ee_position=position,
        ee_quaternion=quaternion,
        ee_velocity=velocity,
        time=np.array([time]),
    )
    state.fill_actions(simulation.actions.action, simulation.actions.last_action)
    return state


def write_episode(path: Path, log: Log, robot: RobotModel) -> None:
    """Write a log as a bag: joint states, and the joint targets as trajectories of one point.

    Args:
        path: a new folder.
        log: what happened; such as the states and targets of an environment's episode.
        robot: the arm.

    Raises:
        GymMaraError: the log is of another arm, the folder exists or cannot be written.
        MissingExtraError: `rosbags` is not installed.
    """
    log.require(robot.joint_names, robot.name)
    from rosbags.typesys.stores import ros2_jazzy as types

    names = list(robot.joint_names)
    none = np.zeros(0)
    ahead = round(1e9 * log.control_period)
    with Recorder(path) as recorder:
        for tick, seconds in enumerate(log.times):
            stamp = round(1e9 * float(seconds - log.times[0]))
            header = types.std_msgs__msg__Header(_time(types, stamp), "")
            state = types.sensor_msgs__msg__JointState(
                header, names, log.q[tick].copy(), log.qd[tick].copy(), none
            )
            recorder.add_value(STATES, state, stamp)
            point = types.trajectory_msgs__msg__JointTrajectoryPoint(
                log.targets[tick].copy(),
                none,
                none,
                none,
                types.builtin_interfaces__msg__Duration(*divmod(ahead, 10**9)),
            )
            recorder.add_value(
                COMMANDS, types.trajectory_msgs__msg__JointTrajectory(header, names, [point]), stamp
            )


def _time(types: Any, stamp: int) -> Any:
    return types.builtin_interfaces__msg__Time(*divmod(stamp, 10**9))
