"""N arms in MuJoCo Warp: the model and the arrays on the device, and the graphs of kernels that move them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from gym_mara.backends.warp.device import bytes_per_arm, capturing, check_memory, compiling
from gym_mara.backends.warp.model import pairs_of_geoms, warp_model
from gym_mara.backends.warp.parameters import ModelParameters
from gym_mara.errors import LARGEST, GymMaraError
from gym_mara.extras import needs
from gym_mara.robot import RobotModel
from gym_mara.types import Floats

with needs("the backend 'warp'", "warp"):
    import mujoco_warp as mjw
    import warp as wp

    from gym_mara.backends.warp import kernels, paths

PATH_RESOLUTION = 0.005
"""The longest way of any point of a travelling arm between two checks for collisions, m: that of PinocchioBackend."""
_ROWS_OF_CONTACT = 4
"""The rows of constraints of a contact with friction."""
_SPARE_CONTACTS = 512
"""The arms share the room for contacts, so a few of them may have many more than the average."""


class Engine:
    """N arms on a device. Each method returns at once; on a GPU the work is done later, in the order of the calls.

    Args:
        robot: the arm.
        num_envs: N.
        device: Warp's device.
        control_period: s.
        physics_step: s; None for arms without dynamics.
        late_periods: the longest latency of a target, whole control periods.
        joint_velocity: the highest (J,), rad/s (m/s).
        teleports: whether arms without dynamics reach their targets at once.
        servo_gain: that of arms without dynamics, 1/s; None for joints without servos.
        max_contacts: the room for contacts of each arm.
        by_pair: whether contacts are noted for each pair of links.
        own_parameters: whether each arm has physical parameters of its own.

    Raises:
        GymMaraError: MuJoCo Warp cannot simulate the robot, or the device has too little memory.
    """

    def __init__(
        self,
        robot: RobotModel,
        num_envs: int,
        device: wp.Device,
        *,
        control_period: float,
        physics_step: float | None,
        late_periods: int,
        joint_velocity: Floats,
        teleports: bool,
        servo_gain: float | None,
        max_contacts: int,
        by_pair: bool,
        own_parameters: bool,
    ) -> None:
        self.robot, self.device, self._num = robot, device, num_envs
        self._dynamics = physics_step is not None
        self._physics_step = control_period if physics_step is None else physics_step
        self._steps = round(control_period / self._physics_step)
        self._period = control_period
        self._gain = 0.0 if servo_gain is None else servo_gain
        model = warp_model(robot, self._physics_step)
        self._rows = model.neq + model.nv + model.ntendon
        rows = self._rows + model.njnt + _ROWS_OF_CONTACT * max_contacts
        room = {"njmax": rows, "naconmax": num_envs * max_contacts + _SPARE_CONTACTS}
        self.bytes_per_arm = bytes_per_arm(model, rows, max_contacts)
        check_memory(device, num_envs, self.bytes_per_arm)
        self.parameters = ModelParameters(model, num_envs) if own_parameters else None
        batch_sizes = self.parameters.batch_sizes if self.parameters else None
        try:
            self.model = mjw.put_model(model, batch_sizes)
        except (NotImplementedError, ValueError) as error:
            raise GymMaraError(f"MuJoCo Warp cannot simulate {robot.name}: {error}") from error
        self.model.opt.warn_overflow = 0  # it prints a line in each step
        self.model.opt.graph_conditional = device.is_cpu or wp.is_conditional_graph_supported()
        self.data = mjw.make_data(model, num_envs, **room)
        self.pairs, pair_of = pairs_of_geoms(robot, model)
        self._pair_of = wp.array(pair_of, dtype=int)
        self._make_arrays(len(self.pairs) if by_pair else 0, late_periods + 2)
        self._limit_motion(joint_velocity, teleports)
        self._place_end_effector(model)
        self._graphs: dict[str, wp.Graph] = {}
        with compiling():
            self._step(steps=1)
            self._look_at_arms()
            self.put_at_rest()

    def _make_arrays(self, pairs: int, targets: int) -> None:
        """Allocate what MuJoCo Warp's data lack."""
        num, joints = self._num, self.robot.num_joints
        self.gain, self.change = wp.ones((num, joints), dtype=float), _zeros(num)
        self.late = _zeros(num, int)
        """The servos' gains, 1/s. A target takes effect after so many whole periods, and this much of the next, s."""
        self._targets = _zeros((num, targets, joints))
        self.target, self.mask = _zeros((num, joints)), _zeros(num, wp.bool)
        self.torque, self.diverged = _zeros((num, joints)), _zeros(num, wp.bool)
        self.depth, self.hit = _zeros((num, pairs)), _zeros(num, int)
        """How deep each pair of links is in contact, m, or `kernels.NO_CONTACT`; whether any pair is."""
        self._looking, self._touching = _zeros(num, int), _zeros(num, int)
        self._stopped, self._samples, self.steps = (_zeros(num, int) for _ in range(3))
        self._start_q, self._start_qd, self._start_warmstart = (
            wp.zeros_like(self.data.qvel) for _ in range(3)
        )
        self.q, self.qd = _zeros((num, joints)), _zeros((num, joints))
        self.position, self.velocity = _zeros((num, 3)), _zeros((num, 3))
        self.quaternion, self.collided = _zeros((num, 4)), _zeros(num, wp.bool)
        self.time, self._status = _zeros(num), _zeros(3, int)
        self.status = wp.zeros(3, dtype=int, device="cpu", pinned=self.device.is_cuda)
        """On the host; `kernels` names its entries. On a GPU it is that of the last step that has ended."""
        data = self.data
        self.state = {
            "q": data.qpos,
            "qd": data.qvel,
            "warmstart": data.qacc_warmstart,
            "torque": self.torque,
            "depth": self.depth,
            "hit": self.hit,
            "looking": self._looking,
            "touching": self._touching,
            "steps": self.steps,
            "diverged": self.diverged,
            "targets": self._targets,
        }
        """All that the future depends on."""

    def _limit_motion(self, joint_velocity: Floats, teleports: bool) -> None:
        """Set how fast joints move, how far arms without dynamics travel in a period, and where followers belong."""
        robot = self.robot
        self._velocity = wp.array(joint_velocity, dtype=float)
        self._reach = wp.array(robot.reach, dtype=float)
        furthest, self._most_samples = joint_velocity * self._period, 1
        if teleports:
            furthest = np.full(robot.num_joints, LARGEST)
        else:
            self._most_samples = max(1, int(np.ceil(furthest @ robot.reach / PATH_RESOLUTION)))
        self._furthest = wp.array(furthest, dtype=float)
        leaders = [follower.leader for follower in robot.followers]
        self._followers = [
            wp.array(leaders, dtype=int),
            wp.array([follower.multiplier for follower in robot.followers], dtype=float),
            wp.array([follower.offset for follower in robot.followers], dtype=float),
        ]

    def _place_end_effector(self, model: Any) -> None:
        frame = self.robot.model.frames[self.robot.ee_frame_id]
        joint = int(frame.parentJoint)
        *place, x, y, z, w = pin.SE3ToXYZQUAT(frame.placement).tolist()
        self._end_effector = [
            int(model.jnt_bodyid[joint - 1]) if joint else 0,
            joint,
            wp.vec3(*place),
            wp.vec4(w, x, y, z),
            wp.array(self.robot.kinematics().prismatic, dtype=int),
        ]

    def step(self) -> None:
        """Move all arms towards `target` for one control period."""
        self._launch("step", self._step)

    def look_at_arms(self) -> None:
        """Report the state of all arms, after a look at those that were put at rest."""
        self._launch("look", self._look_at_arms)

    def _launch(self, name: str, function: Callable[[], None]) -> None:
        """Launch the kernels of a function as a graph, which is captured the first time."""
        if name not in self._graphs:
            with capturing(self.device) as capture:
                function()
            self._graphs[name] = capture.graph
        stream = wp.get_stream() if self.device.is_cuda else None
        wp.capture_launch(self._graphs[name], stream=stream)
        wp.copy(self.status, self._status)

    def _step(self, steps: int | None = None) -> None:
        data = self.data
        before = [self._start_q, self._start_qd, self._start_warmstart]
        now = [data.qpos, data.qvel, data.qacc_warmstart]
        contacts = [self.depth, self.hit]
        begun = [self.target, self._targets, *now, *before, *contacts, self._looking]
        self._over_arms(kernels.begin, begun)
        if not self._dynamics:
            self._travel()
            self._report()
            return
        for number in range(self._steps if steps is None else steps):
            mjw.step1(self.model, data)
            self._count_contacts()
            self._command(number * self._physics_step)
            mjw.step2(self.model, data)
        rows = [data.efc.type, data.efc.id, data.nefc, data.efc.force, self.torque]
        wp.launch(kernels.read_torque, (self._num, self._rows), rows)
        judged = [*now, self.torque, *contacts, self.steps, self.diverged]
        told = [data.overflow, self._status]
        self._over_arms(kernels.judge, [self._velocity, *before, *judged, *told])
        self._look_at_arms()

    def _command(self, time: float) -> None:
        data = self.data
        servo = [self._start_q, self._targets, self.late, self.change, self.gain, self._velocity]
        rows = [data.qvel, data.efc.type, data.efc.id, data.nefc, data.efc.aref]
        arguments = [*servo, time, self._physics_step, *rows]
        wp.launch(kernels.command, (self._num, self._rows), arguments)

    def _travel(self) -> None:
        """Move along the paths of one period without dynamics, and look for collisions on them."""
        qpos, furthest = self.data.qpos, self._furthest
        path, samples = [self._start_q, self.target], [self._samples, self._stopped]
        initial = self._gain * self._period or 1.0
        planned = [furthest, self._reach, initial, PATH_RESOLUTION, *samples]
        self._over_arms(paths.plan_path, [*path, *planned])
        law = [furthest, self._velocity, self._gain, self._period]
        for sample in range(1, self._most_samples + 1):
            moved = [self._samples, sample, self._stopped, *self._followers, qpos]
            self._over_arms(paths.travel, [*path, *law, *moved])
            self._find_contacts()
            self._over_arms(paths.stop, [self.hit, self._touching, self._stopped])
        ended = [self.hit, self._stopped, qpos, self.data.qvel, self._touching, self.steps]
        self._over_arms(paths.arrive, [*path, self._velocity, self._gain, *ended])

    def put_at_rest(self) -> None:
        """Put the arms of `mask` at rest at `target`."""
        data = self.data
        moved = [data.qpos, data.qvel, data.qacc_warmstart, self.torque, self.depth, self.hit]
        known = [self._looking, self._touching, self.steps, self.diverged, self._targets]
        arguments = [self.mask, self.target, *self._followers, *moved, *known]
        self._over_arms(kernels.put_at_rest, arguments)

    def _look_at_arms(self) -> None:
        self._find_contacts()
        self._report()

    def _find_contacts(self) -> None:
        mjw.kinematics(self.model, self.data)
        mjw.collision(self.model, self.data)
        self._count_contacts()

    def _count_contacts(self) -> None:
        data, contact = self.data, self.data.contact
        found = [data.nacon, data.ncollision, contact.worldid, contact.geom, contact.dist]
        noted = [self._pair_of, self._looking, self.depth, self.hit, self._status]
        wp.launch(kernels.count_contacts, data.naconmax, [*found, *noted])

    def _report(self) -> None:
        data = self.data
        moved = [data.qpos, data.qvel, self._velocity, self.hit, self.steps, self._period]
        bodies = [data.xpos, data.xquat, data.xanchor, data.xaxis]
        known = [self._looking, data.overflow, self._status]
        state = [self.q, self.qd, self.position, self.quaternion, self.velocity]
        arguments = [*moved, *self._end_effector, *bodies, *known, *state, self.collided, self.time]
        self._over_arms(kernels.report, arguments)

    def take_status(self) -> NDArray[np.int32]:
        """Wait for the device, and return what `status` tells then, which is forgotten."""
        wp.synchronize_device()
        status: NDArray[np.int32] = self.status.numpy().copy()
        self._status.zero_()
        self.status.zero_()
        return status

    def _over_arms(self, kernel: Any, arguments: list[Any]) -> None:
        wp.launch(kernel, self._num, arguments)


def _zeros(shape: int | tuple[int, ...], dtype: Any = float) -> wp.array:
    return wp.zeros(shape, dtype=dtype)
