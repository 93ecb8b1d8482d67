"""The backend "mujoco": MuJoCo integrates the motion of the arms, with position servos and contact."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from gym_mara.backends.servo import Motion, ServoBackend
from gym_mara.collision import make_checker
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.robot.description.shapes import Box, Capsule, Cylinder, Mesh, Shape, Sphere
from gym_mara.snapshots import check_fits
from gym_mara.state import Contact
from gym_mara.types import Floats

_WANTED = "the backend 'mujoco' needs MuJoCo 3.3 or newer: pip install 'mujoco>=3.3'"
try:
    import mujoco
except ImportError as error:
    raise GymMaraError(_WANTED) from error
if tuple(int(part) for part in mujoco.__version__.split(".")[:2]) < (3, 3):
    raise GymMaraError(f"{_WANTED}; this is {mujoco.__version__}")

# All that the next step depends on, the solver's starting point included.
_STATE = mujoco.mjtState.mjSTATE_INTEGRATION.value
# The impedance of a motor's constraint, between 0 and 1: the highest that MuJoCo allows.
_HARD = mujoco.mjMAXIMP


class MujocoBackend(ServoBackend):
    """Full dynamics by MuJoCo.

    MuJoCo replaces a mesh by its convex hull, and hulls that touch push each other. Where it has a contact, Coal decides
    on the meshes whether the arm has collided: so `collided` is the same at equal q as in the other backends.

    Args:
        robot: the arm.
        num_envs: the number of arms.
        control_period: s.
        physics_step: s; a control period is a whole number of them.
        max_joint_velocity: rad/s (m/s), where it is below the URDF's limits; None for those.
        servo_gain: 1/s.
        on_divergence: what follows when an arm's state diverges: "error", or "truncate" to end the arm's episode.

    Raises:
        GymMaraError: a setting is out of its range, or MuJoCo cannot load the robot.
    """

    # Python commands the motors at every physics step, and holds its lock meanwhile.
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
        on_divergence: str = "error",
    ) -> None:
        super().__init__(
            robot,
            num_envs,
            control_period=control_period,
            physics_step=physics_step,
            max_joint_velocity=max_joint_velocity,
            servo_gain=servo_gain,
            on_divergence=on_divergence,
        )
        self._checker = make_checker("coal", robot)
        self._model = build_model(robot, self.physics_step)
        # MuJoCo orders its constraints: first those of joints that follow, of the joints' friction, then those of the motors.
        first = len(robot.followers) + np.count_nonzero(self._model.dof_frictionloss)
        self._motors = slice(first, first + robot.num_joints)
        names = [shape.name for shape in robot.geometry.geometryObjects]
        geoms = [names.index(self._model.geom(index).name) for index in range(self._model.ngeom)]
        self._links = [robot.link_of(index) for index in geoms]
        self._arms = [mujoco.MjData(self._model) for _ in range(num_envs)]
        self.reset(np.tile(robot.home, (num_envs, 1)))

    def _run(self, velocities: Floats) -> Motion:
        runs = [self._run_arm(arm, velocities[:, index]) for index, arm in enumerate(self._arms)]
        return Motion(
            q=np.array([arm.qpos[: self.robot.num_joints] for arm in self._arms]),
            qd=np.array([arm.qvel[: self.robot.num_joints] for arm in self._arms]),
            torque=np.array([torque for torque, _ in runs]),
            contacts=[contacts for _, contacts in runs],
        )

    def _run_arm(
        self, arm: mujoco.MjData, velocities: Floats
    ) -> tuple[Floats, tuple[Contact, ...]]:
        """One physics step of an arm for each row of commanded joint velocities (K, J); the last torque, and the contacts.

        An arm is always left between the two halves of a step: its contacts and constraints are those of its current q.
        """
        deepest: dict[tuple[str, str], float] = {}
        for velocity in velocities:
            # The motor's friction is made for a shaft at rest; this makes the shaft turn, see `_add_joint`.
            arm.efc_aref[self._motors] = (velocity - arm.qvel[: len(velocity)]) / self.physics_step
            mujoco.mj_step2(self._model, arm)
            torque = arm.efc_force[self._motors].copy()
            mujoco.mj_step1(self._model, arm)
            for contact in self._contacts_of(arm):
                deepest[contact.links] = max(contact.depth, deepest.get(contact.links, 0.0))
        return torque, tuple(Contact(links, depth) for links, depth in sorted(deepest.items()))

    def _contacts_of(self, arm: mujoco.MjData) -> list[Contact]:
        """MuJoCo's contacts where the arm is now; none where the links' meshes do not touch, although their hulls may."""
        if arm.ncon == 0 or not self._checker.check(arm.qpos[None, : self.robot.num_joints])[0]:
            return []
        found = zip(arm.contact.geom.tolist(), arm.contact.dist.tolist(), strict=True)
        pairs = [(sorted(self._links[geom] for geom in geoms), dist) for geoms, dist in found]
        return [Contact((one, other), max(-dist, 0.0)) for (one, other), dist in pairs]

    def _put_at_rest(self, arm: int, q: Floats) -> tuple[Contact, ...]:
        self._set_state(arm, q, np.zeros_like(q))
        return tuple(self._contacts_of(self._arms[arm]))

    def _rebuild(self, arm: int, q: Floats, qd: Floats) -> None:
        self._set_state(arm, q, qd)

    def _set_state(self, arm: int, q: Floats, qd: Floats) -> None:
        data = self._arms[arm]
        mujoco.mj_resetData(self._model, data)
        followers = self.robot.followers
        data.qpos[:] = np.append(q, [each.position(q) for each in followers])
        data.qvel[:] = np.append(qd, [each.velocity(qd) for each in followers])
        mujoco.mj_step1(self._model, data)

    def save(self) -> dict[str, Any]:
        """A snapshot, with MuJoCo's state of every arm (N, S)."""
        states = self._empty_states()
        for arm, state in zip(self._arms, states, strict=True):
            mujoco.mj_getState(self._model, arm, state, _STATE)
        return super().save() | {"states": states}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Return to a snapshot; MuJoCo computes again what follows from a state.

        Raises:
            GymMaraError: it does not fit. Nothing has changed then.
        """
        check_fits("states", snapshot.get("states"), self._empty_states())
        super().restore(snapshot)
        for arm, state in zip(self._arms, snapshot["states"], strict=True):
            mujoco.mj_setState(self._model, arm, state, _STATE)
            mujoco.mj_step1(self._model, arm)

    def _empty_states(self) -> Floats:
        return np.zeros((self.num_envs, mujoco.mj_stateSize(self._model, _STATE)))


def build_model(robot: RobotModel, physics_step: float) -> mujoco.MjModel:
    """MuJoCo's model of a robot: a body for each joint, a motor on each joint, and the pairs that may collide.

    Raises:
        GymMaraError: MuJoCo cannot load it.
    """
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = physics_step
    spec.option.gravity = robot.model.gravity.linear
    # Where an arm's state diverges MuJoCo would silently reset it.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
    bodies = [spec.worldbody]
    for number in range(1, robot.model.njoints):
        bodies.append(_add_joint(spec, robot, number, bodies[robot.model.parents[number]]))
    shapes = robot.geometry.geometryObjects
    for geometry, shape in zip(shapes, robot.shapes, strict=True):
        _add_shape(spec, bodies[geometry.parentJoint], geometry, shape)
    for pair in robot.geometry.collisionPairs:
        spec.add_pair(geomname1=shapes[pair.first].name, geomname2=shapes[pair.second].name)
    try:
        model = spec.compile()
    except ValueError as error:
        raise GymMaraError(f"MuJoCo cannot load the robot {robot.name!r}: {error}") from error
    # Here it is one number per joint in every version of MuJoCo; in MjSpec it is not.
    model.dof_damping[: robot.num_joints] = robot.model.damping
    return model


def _add_joint(spec: Any, robot: RobotModel, number: int, parent: Any) -> Any:
    """Add a joint of Pinocchio's model, the body that it carries, and its motor or what it follows; returns the body.

    A motor acts like a clutch between the joint and a shaft that turns as commanded; it slips beyond the effort limit.
    It is modelled as friction on a tendon that only this joint pulls, so that MuJoCo's solver computes the motors' torques
    together with the contact forces.
    """
    name, inertia = robot.model.names[number], robot.model.inertias[number]
    follows = number > robot.num_joints
    if follows and inertia.mass <= 0.0:
        inertia = pin.Inertia(1e-9, np.zeros(3), 1e-9 * np.eye(3))
    body = parent.add_body(
        mass=inertia.mass,
        ipos=inertia.lever,
        fullinertia=inertia.inertia[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)],
        explicitinertial=True,
        **_placed(robot.model.jointPlacements[number]),
    )
    linear, angular = np.split(robot.motion(number), 2)
    kind = mujoco.mjtJoint.mjJNT_HINGE if angular.any() else mujoco.mjtJoint.mjJNT_SLIDE
    joint = body.add_joint(name=name, type=kind, axis=angular if angular.any() else linear)
    # As hard as MuJoCo allows with this physics step.
    hard = {"solref": (2.0 * spec.option.timestep, 1.0), "solimp": (_HARD, _HARD, 1.0, 0.5, 1.0)}
    if follows:
        follower = robot.followers[number - 1 - robot.num_joints]
        spec.add_equality(
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1=name,
            name2=robot.joint_names[follower.leader],
            data=[follower.offset, follower.multiplier, *[0.0] * (mujoco.mjNEQDATA - 2)],
            **hard,
        )
        return body
    joint.limited = True
    joint.range = robot.lower[number - 1], robot.upper[number - 1]
    joint.solref_limit, joint.solimp_limit = hard["solref"], hard["solimp"]
    joint.frictionloss = robot.model.friction[number - 1]
    motor = spec.add_tendon(
        # MuJoCo makes no constraint for friction of zero.
        frictionloss=max(robot.effort_limit[number - 1], mujoco.mjMINVAL),
        solimp_friction=(_HARD, _HARD, 1.0, 0.5, 1.0),
    )
    motor.wrap_joint(name, 1.0)
    return body


def _add_shape(spec: Any, body: Any, geometry: pin.GeometryObject, shape: Shape) -> None:
    """Add a shape where Pinocchio's geometry object is; it collides only in the pairs that `build_model` adds."""
    kinds, options = mujoco.mjtGeom, dict[str, Any]()
    match shape:
        case Box(size):
            options = {"type": kinds.mjGEOM_BOX, "size": 0.5 * size}
        case Sphere(radius):
            options = {"type": kinds.mjGEOM_SPHERE, "size": (radius, 0.0, 0.0)}
        case Cylinder(radius, length):
            options = {"type": kinds.mjGEOM_CYLINDER, "size": (radius, 0.5 * length, 0.0)}
        case Capsule(radius, length):
            options = {"type": kinds.mjGEOM_CAPSULE, "size": (radius, 0.5 * length, 0.0)}
        case Mesh() as mesh:
            spec.add_mesh(
                name=geometry.name,
                uservert=mesh.vertices.ravel(),
                inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,  # unused, but MuJoCo computes one
            )
            options = {"type": kinds.mjGEOM_MESH, "meshname": geometry.name}
    placement = _placed(geometry.placement)
    body.add_geom(name=geometry.name, contype=0, conaffinity=0, **options, **placement)


def _placed(placement: pin.SE3) -> dict[str, list[float]]:
    """A placement as MuJoCo's keyword arguments: position, and quaternion [w, x, y, z]."""
    *position, x, y, z, w = pin.SE3ToXYZQUAT(placement).tolist()
    return {"pos": position, "quat": [w, x, y, z]}
