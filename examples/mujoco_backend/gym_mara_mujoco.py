"""The backend "mujoco": MuJoCo simulates the arms, with position servos on the joints and contact."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from gym_mara.backends import Backend
from gym_mara.backends.servo import servo_motion, step_times
from gym_mara.collision import make_checker
from gym_mara.errors import GymMaraError, positive_number
from gym_mara.robot import RobotModel
from gym_mara.robot.kinematics import motion_axis
from gym_mara.state import SimState

_WANTED = "the backend 'mujoco' needs MuJoCo 3.3 or newer: pip install 'mujoco>=3.3'"
try:
    import mujoco
except ImportError as error:
    raise GymMaraError(_WANTED) from error
if tuple(int(part) for part in mujoco.__version__.split(".")[:2]) < (3, 3):
    raise GymMaraError(f"{_WANTED}; this is {mujoco.__version__}")

Floats = NDArray[np.float64]

# Everything that the next step depends on, including the start values of the solver.
_STATE = mujoco.mjtState.mjSTATE_INTEGRATION.value
# The largest stiffness of a motor that MuJoCo allows, from 0 to 1.
_HARD = mujoco.mjMAXIMP


class MujocoBackend(Backend):
    """Full dynamics: gravity, inertia, contact, and motors of limited torque and speed.

    Each joint has a position servo. At every physics step its motor is commanded the velocity clip(gain · (target - q), ±
    the velocity limit of the URDF), and applies the torque that this needs, up to the effort limit of the URDF.

    MuJoCo replaces meshes by their convex hulls, and these push each other apart. If MuJoCo has a contact, Coal decides
    whether it is a collision. At equal q, `collided` is therefore the same as in the other backends.

    Args:
        robot: the arm.
        num_envs: number of arms.
        control_period: s.
        physics_step: s; it must divide the control period.
        max_joint_velocity: a limit below those of the URDF, rad/s (m/s); None for those of the URDF.
        servo_gain: 1/s.

    Raises:
        GymMaraError: a setting is out of range, or MuJoCo cannot load the robot.
    """

    # Python commands the motors at every physics step, and holds its lock while it does.
    in_processes = True

    def __init__(
        self,
        robot: RobotModel,
        num_envs: int,
        *,
        control_period: float = 0.02,
        physics_step: float = 0.002,
        max_joint_velocity: float | None = None,
        servo_gain: float = 10.0,
    ) -> None:
        super().__init__(robot, num_envs, control_period=control_period)
        self._settings = {
            "control_period": control_period,
            "physics_step": physics_step,
            "max_joint_velocity": max_joint_velocity,
            "servo_gain": servo_gain,
        }
        self.physics_step = positive_number("physics_step", physics_step, "s")
        self._times = step_times(self.control_period, self.physics_step)[:, None, None]
        if max_joint_velocity is not None:
            limit = positive_number("max_joint_velocity", max_joint_velocity, "rad/s")
            self.joint_velocity = np.minimum(limit, robot.velocity_limit)
        self.servo_gain = positive_number("servo_gain", servo_gain, "1/s")
        self._gain = np.full(robot.num_joints, self.servo_gain)
        self._kinematics = robot.kinematics()
        self._checker = make_checker("coal", robot)
        self._model = build_model(robot, self.physics_step)
        # In MuJoCo's list of constraints, joint friction comes first, then the motors.
        first = np.count_nonzero(self._model.dof_frictionloss)
        self._motors = slice(first, first + robot.num_joints)
        self._arms = [mujoco.MjData(self._model) for _ in range(num_envs)]
        self._torque = np.zeros((num_envs, robot.num_joints))
        self._collided = np.zeros(num_envs, dtype=np.bool_)
        self.reset(np.tile(robot.home, (num_envs, 1)))

    def reset(self, q: Floats, mask: NDArray[np.bool_] | None = None) -> None:
        """Put the arms of the mask, or all arms, at rest at q."""
        rows = np.ones(self.num_envs, np.bool_) if mask is None else mask
        for index in np.flatnonzero(rows).tolist():
            arm = self._arms[index]
            mujoco.mj_resetData(self._model, arm)
            arm.qpos[:] = q[index]
            mujoco.mj_step1(self._model, arm)
            self._torque[index] = 0.0
            self._collided[index] = self._collides(arm)

    def step(self, q_target: Floats) -> SimState:
        """Plan the velocity commands of the servos for this period, and run the arms one after the other."""
        q = np.array([arm.qpos for arm in self._arms])
        path = servo_motion(q, q_target, self._gain, self.joint_velocity, self._times)
        velocities = np.diff(path, axis=0) / self.physics_step
        for index in range(self.num_envs):
            self._run(index, velocities[:, index])
        return self.state

    def _run(self, index: int, velocities: Floats) -> None:
        """Run one physics step of an arm for each row of commanded joint velocities (K, J).

        An arm always stops between the two halves of a step, so that contacts and constraints match its position.
        """
        arm, collided = self._arms[index], False
        for velocity in velocities:
            # The friction of the motors assumes a shaft at rest: write the shaft's velocity into it, see `_add_joint`.
            arm.efc_aref[self._motors] = (velocity - arm.qvel) / self.physics_step
            mujoco.mj_step2(self._model, arm)
            self._torque[index] = arm.efc_force[self._motors]
            mujoco.mj_step1(self._model, arm)
            collided = collided or self._collides(arm)
        self._collided[index] = collided
        if not (np.isfinite(arm.qpos).all() and np.isfinite(arm.qvel).all()):
            raise GymMaraError(
                f"the simulation of arm {index} diverged; a shorter physics_step may help"
            )

    def _collides(self, arm: mujoco.MjData) -> bool:
        """Whether links touch; without a contact of their hulls they do not."""
        return arm.ncon > 0 and bool(self._checker.check(arm.qpos[None])[0])

    @property
    def state(self) -> SimState:
        """The current state."""
        # MuJoCo's constraints are soft: a joint can exceed its limits slightly.
        q = np.clip([arm.qpos for arm in self._arms], self.robot.lower, self.robot.upper)
        qd = np.clip([a.qvel for a in self._arms], -self.joint_velocity, self.joint_velocity)
        position, quaternion = self._kinematics.pose(q)
        return SimState(
            q=q,
            qd=qd,
            ee_position=position,
            ee_quaternion=quaternion,
            ee_velocity=self._kinematics.velocity(q, qd),
            collided=self._collided.copy(),
            time=np.array([arm.time for arm in self._arms]),
        )

    def report(self) -> dict[str, NDArray[Any]]:
        """Torques of the motors in the last physics step (N, J), Nm."""
        return {"joint_torque": self._torque.copy()}

    def save(self) -> dict[str, Any]:
        """MuJoCo's state of every arm (N, S), and the values that it does not include."""
        states = np.empty((self.num_envs, mujoco.mj_stateSize(self._model, _STATE)))
        for arm, state in zip(self._arms, states, strict=True):
            mujoco.mj_getState(self._model, arm, state, _STATE)
        return {
            "states": states,
            "torque": self._torque.copy(),
            "collided": self._collided.copy(),
        }

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go back to a snapshot; values that follow from the state are computed again."""
        if snapshot["torque"].shape != self._torque.shape:
            raise GymMaraError(
                f"the snapshot is of arms {snapshot['torque'].shape}; these are {self._torque.shape}"
            )
        for arm, state in zip(self._arms, snapshot["states"], strict=True):
            mujoco.mj_setState(self._model, arm, state, _STATE)
            mujoco.mj_step1(self._model, arm)
        self._torque, self._collided = snapshot["torque"].copy(), snapshot["collided"].copy()

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (self.robot, self.num_envs, self._settings, self.save())


def _restored(
    robot: RobotModel, num_envs: int, settings: dict[str, Any], snapshot: dict[str, Any]
) -> MujocoBackend:
    backend = MujocoBackend(robot, num_envs, **settings)
    backend.restore(snapshot)
    return backend


def build_model(robot: RobotModel, physics_step: float) -> mujoco.MjModel:
    """Build MuJoCo's model of a robot: a body and a motor for each joint, and the pairs that may collide.

    Raises:
        GymMaraError: MuJoCo cannot load the robot.
    """
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = physics_step
    spec.option.gravity = robot.model.gravity.linear
    # If the state of an arm diverges, raise an error; do not let MuJoCo reset the arm silently.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
    bodies = [spec.worldbody]
    for number in range(1, robot.model.njoints):
        bodies.append(_add_joint(spec, robot, number, bodies[robot.model.parents[number]]))
    shapes = robot.geometry.geometryObjects
    for shape in shapes:
        _add_shape(spec, bodies[shape.parentJoint], shape)
    for pair in robot.geometry.collisionPairs:
        spec.add_pair(geomname1=shapes[pair.first].name, geomname2=shapes[pair.second].name)
    try:
        model = spec.compile()
    except ValueError as error:
        raise GymMaraError(f"MuJoCo does not take the robot {robot.name!r}: {error}") from error
    # Here there is one value per joint in every version of MuJoCo; in MjSpec there is not.
    model.dof_damping[:] = robot.model.damping
    return model


def _add_joint(spec: Any, robot: RobotModel, number: int, parent: Any) -> Any:
    """Add a joint of Pinocchio's model, its body and its motor; return the body.

    A motor works like a clutch between the joint and a shaft that turns at the commanded velocity; it slips above the effort
    limit. It is modelled as friction on a tendon that is attached only to this joint. MuJoCo's solver therefore computes the
    torque together with the contact forces.
    """
    name, inertia = robot.model.names[number], robot.model.inertias[number]
    body = parent.add_body(
        mass=inertia.mass,
        ipos=inertia.lever,
        fullinertia=inertia.inertia[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)],
        explicitinertial=True,
        **_placed(robot.model.jointPlacements[number]),
    )
    linear, angular = np.split(motion_axis(robot.model.joints[number]), 2)
    kind = mujoco.mjtJoint.mjJNT_HINGE if angular.any() else mujoco.mjtJoint.mjJNT_SLIDE
    body.add_joint(
        name=name,
        type=kind,
        axis=angular if angular.any() else linear,
        limited=True,
        range=(robot.lower[number - 1], robot.upper[number - 1]),
        frictionloss=robot.model.friction[number - 1],
    )
    motor = spec.add_tendon(
        # MuJoCo has no constraint for a motor with an effort limit of zero.
        frictionloss=max(robot.effort_limit[number - 1], mujoco.mjMINVAL),
        solimp_friction=(_HARD, _HARD, 1.0, 0.5, 1.0),
    )
    motor.wrap_joint(name, 1.0)
    return body


def _add_shape(spec: Any, body: Any, shape: pin.GeometryObject) -> None:
    """Add one of Pinocchio's geometry objects; it collides only with the shapes of its pairs."""
    geometry, kinds = shape.geometry, mujoco.mjtGeom
    name = type(geometry).__name__
    options: dict[str, Any]
    if name == "Box":
        options = {"type": kinds.mjGEOM_BOX, "size": geometry.halfSide}
    elif name == "Sphere":
        options = {"type": kinds.mjGEOM_SPHERE, "size": (geometry.radius, 0.0, 0.0)}
    elif name in ("Cylinder", "Capsule"):
        kind = kinds.mjGEOM_CYLINDER if name == "Cylinder" else kinds.mjGEOM_CAPSULE
        options = {"type": kind, "size": (geometry.radius, geometry.halfLength, 0.0)}
    elif name.startswith("BVHModel"):
        spec.add_mesh(
            name=shape.name,
            uservert=geometry.vertices().ravel(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,  # has no effect, but must be set
        )
        options = {"type": kinds.mjGEOM_MESH, "meshname": shape.name}
    else:
        raise GymMaraError(f"the backend 'mujoco' does not know the shape {name} of {shape.name!r}")
    body.add_geom(name=shape.name, contype=0, conaffinity=0, **options, **_placed(shape.placement))


def _placed(placement: pin.SE3) -> dict[str, list[float]]:
    """A placement as MuJoCo's arguments: position, and quaternion [w, x, y, z]."""
    *position, x, y, z, w = pin.SE3ToXYZQUAT(placement).tolist()
    return {"pos": position, "quat": [w, x, y, z]}
