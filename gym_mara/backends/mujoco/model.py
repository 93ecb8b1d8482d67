"""MuJoCo's model of a robot, for MuJoCo itself and for MuJoCo Warp."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pinocchio as pin

from gym_mara.errors import GymMaraError
from gym_mara.extras import needs
from gym_mara.robot import RobotModel
from gym_mara.robot.description.shapes import Box, Capsule, Cylinder, Mesh, Shape, Sphere
from gym_mara.types import Floats

with needs("the backend 'mujoco'", "mujoco"):
    import mujoco

SHAFT_INERTIA = 1e4
"""The inertia of a motor's shaft, kg·m² (kg): so large that no motor slows it down, so small that double precision has
digits left for the motor's torque."""
# MuJoCo needs a mass for every body; kg and kg·m². Those of a link are in the body of its joint. A joint that follows another
# needs more for the solver.
_NO_INERTIA = pin.Inertia(1e-9, np.zeros(3), 1e-9 * np.eye(3))
_LINK_INERTIA = pin.Inertia(1e-13, np.zeros(3), 1e-13 * np.eye(3))
# The impedance of a constraint, between 0 and 1: the highest that MuJoCo allows.
_HARD = (mujoco.mjMAXIMP, mujoco.mjMAXIMP, 1.0, 0.5, 1.0)
# Contacts are nearly as hard, and strongly overdamped: links that touch stop at once, but links that a reset puts deep into
# each other are pushed apart slowly. With MuJoCo's own values MARA sinks 15 mm into the table at full speed, with these 3 mm.
_CONTACT_IMPEDANCE = (0.999, mujoco.mjMAXIMP, 0.001, 0.5, 2.0)
_CONTACT_DAMPING = 40.0

_THIN = 5e-5
"""Half the thickness of what is flat, m."""


def build_model(robot: RobotModel, physics_step: float, *, shafts: bool = True) -> mujoco.MjModel:
    """MuJoCo's model of a robot, with its motors, end stops, and the pairs of links that may collide.

    A motor acts like a clutch between a joint and a shaft that turns at the commanded velocity: it slips beyond the effort
    limit. The clutch is friction on a tendon that the joint and the shaft pull, so that MuJoCo's solver computes the motors'
    torques together with the contact forces. Joints come first, then those that follow others, then the shafts.

    Args:
        robot: the arm.
        physics_step: s.
        shafts: whether the shafts are part of the model, with an actuator each, whose control is the velocity, rad/s (m/s).
            Then a sensor for each of `link_pairs` gives the pair's smallest distance, m: negative in contact, else 0.
            Without shafts whoever steps the model writes the velocities into the constraints, and one sensor counts the
            contacts.

    Raises:
        GymMaraError: MuJoCo cannot load it.
    """
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = physics_step
    spec.option.gravity = robot.model.gravity.linear
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    if shafts:
        # The solver stops where an error costs little energy, compared with the inertia of all joints. The shafts' is so
        # large that motors of light joints were wrong by some Nm.
        spec.option.tolerance = 1e-14
    bits = mujoco.mjtDisableBit
    # MuJoCo would silently reset an arm whose state diverges. Links that a joint connects may be a pair that collides.
    # Islands cost more than they save in a model of one arm.
    for bit in (bits.mjDSBL_AUTORESET, bits.mjDSBL_FILTERPARENT, bits.mjDSBL_ISLAND):
        spec.option.disableflags |= bit.value
    bodies = [spec.worldbody]
    for number in range(1, robot.model.njoints):
        bodies.append(_add_joint(spec, robot, number, bodies[robot.model.parents[number]]))
    _add_links(spec, robot, bodies)
    for number in range(1, robot.num_joints + 1):
        _add_motor(spec, robot, number, shafts)
    _add_contact_sensors(spec, robot, pairs=shafts)
    try:
        model = spec.compile()
    except ValueError as error:
        raise GymMaraError(f"MuJoCo cannot load the robot {robot.name!r}: {error}") from error
    # Here it is one number per joint in every version of MuJoCo; in MjSpec it is not.
    model.dof_damping[: robot.num_joints] = robot.model.damping
    return model


def set_parameters(
    model: mujoco.MjModel,
    nominal: mujoco.MjModel,
    mass: Floats | None = None,
    effort_limit: Floats | None = None,
    joint_friction: Floats | None = None,
    contact_friction: Floats | None = None,
) -> None:
    """Set the physical parameters in which an arm's own model differs from the nominal one; None for the nominal value.

    Args:
        model: the arm's own.
        nominal: that of the robot.
        mass: scale of the mass and inertia of each joint's body (J,).
        effort_limit: scale of each motor's effort limit (J,).
        joint_friction: Coulomb friction of each joint (J,), Nm (N).
        contact_friction: coefficient of friction of all surfaces ().
    """
    if effort_limit is not None:
        model.tendon_frictionloss[:] = np.maximum(
            effort_limit * nominal.tendon_frictionloss, mujoco.mjMINVAL
        )
    if joint_friction is not None:
        model.dof_frictionloss[: len(joint_friction)] = joint_friction
    if contact_friction is not None:
        model.geom_friction[:, 0] = contact_friction
    if mass is not None:
        bodies = nominal.jnt_bodyid[: len(mass)]
        model.body_mass[bodies] = mass * nominal.body_mass[bodies]
        model.body_inertia[bodies] = mass[:, None] * nominal.body_inertia[bodies]
        mujoco.mj_setConst(model, mujoco.MjData(model))


def without_forces(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy in which nothing but contacts acts, for steps that only measure distances: they take half the time."""
    still = copy.copy(model)
    bits = mujoco.mjtDisableBit
    for bit in (
        *(bits.mjDSBL_EQUALITY, bits.mjDSBL_FRICTIONLOSS, bits.mjDSBL_LIMIT, bits.mjDSBL_WARMSTART),
        *(bits.mjDSBL_ACTUATION, bits.mjDSBL_GRAVITY, bits.mjDSBL_EULERDAMP),
    ):
        still.opt.disableflags |= bit.value
    return still


def link_pairs(robot: RobotModel) -> list[tuple[str, str]]:
    """The pairs of links that may collide, each in alphabetical order, in the order of the sensors."""
    return sorted((min(pair), max(pair)) for pair in robot.collision_pairs)


def link_of_geoms(robot: RobotModel, model: mujoco.MjModel) -> list[str]:
    """The name of the link to which each of MuJoCo's shapes belongs."""
    names = [shape.name for shape in robot.geometry.geometryObjects]
    geoms = [names.index(model.geom(index).name) for index in range(model.ngeom)]
    return [robot.link_of(index) for index in geoms]


def _hard(spec: Any) -> dict[str, Any]:
    """A constraint as hard as MuJoCo allows with this physics step."""
    return {"solref": (2.0 * spec.option.timestep, 1.0), "solimp": _HARD}


def _add_joint(spec: Any, robot: RobotModel, number: int, parent: Any) -> Any:
    """Add a joint of Pinocchio's model, its end stops or what it follows, and the body that it carries; returns the body."""
    name, inertia = robot.model.names[number], robot.model.inertias[number]
    follows = number > robot.num_joints
    if inertia.mass <= 0.0:  # one that counts is refused earlier
        inertia = _NO_INERTIA
    body = _add_body(parent, inertia, **_placed(robot.model.jointPlacements[number]))
    linear, angular = np.split(robot.motion(number), 2)
    kind = mujoco.mjtJoint.mjJNT_HINGE if angular.any() else mujoco.mjtJoint.mjJNT_SLIDE
    joint = body.add_joint(name=name, type=kind, axis=angular if angular.any() else linear)
    if follows:
        follower = robot.followers[number - 1 - robot.num_joints]
        spec.add_equality(
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1=name,
            name2=robot.joint_names[follower.leader],
            data=[follower.offset, follower.multiplier, *[0.0] * (mujoco.mjNEQDATA - 2)],
            **_hard(spec),
        )
        return body
    joint.limited = True
    joint.range = robot.lower[number - 1], robot.upper[number - 1]
    joint.solref_limit, joint.solimp_limit = _hard(spec).values()
    joint.frictionloss = robot.model.friction[number - 1]
    joint.solref_friction, joint.solimp_friction = _hard(spec).values()
    return body


def _add_motor(spec: Any, robot: RobotModel, number: int, shafts: bool) -> None:
    """Add the motor of a joint."""
    name, hard = robot.model.names[number], _hard(spec)
    clutch = spec.add_tendon(
        name=name,
        # MuJoCo makes no constraint for friction of zero.
        frictionloss=max(robot.effort_limit[number - 1], mujoco.mjMINVAL),
        solref_friction=hard["solref"],
        solimp_friction=hard["solimp"],
    )
    clutch.wrap_joint(name, 1.0)
    if not shafts:
        return
    inertia = pin.Inertia(SHAFT_INERTIA, np.zeros(3), SHAFT_INERTIA * np.eye(3))
    shaft = f"shaft of {name}"
    body = _add_body(spec.worldbody, inertia)
    body.add_joint(name=shaft, type=mujoco.mjtJoint.mjJNT_HINGE, axis=(0.0, 0.0, 1.0))
    clutch.wrap_joint(shaft, -1.0)
    # With this gain a shaft that nothing holds back reaches the commanded velocity in one physics step.
    gain = SHAFT_INERTIA / spec.option.timestep
    motor = spec.add_actuator(name=name, target=shaft, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.set_to_velocity(kv=gain)


def _add_links(spec: Any, robot: RobotModel, bodies: list[Any]) -> None:
    """Add the shapes of each link, on a body with the name of the link; exclude the pairs of links that may not collide.

    With pairs of bodies MuJoCo compares boxes around the shapes; with a list of pairs of shapes it compares only spheres,
    which took twice as long for MARA's table.
    """
    links: dict[str, Any] = {}
    shapes = robot.geometry.geometryObjects
    for index, (geometry, shape) in enumerate(zip(shapes, robot.shapes, strict=True)):
        link = robot.link_of(index)
        if link not in links:
            links[link] = _add_body(bodies[geometry.parentJoint], _LINK_INERTIA)
            links[link].name = f"link {link}"
        _add_shape(spec, links[link], geometry, shape)
    names = list(links)
    for index, one in enumerate(names):
        for other in names[:index]:
            if frozenset((one, other)) not in robot.collision_pairs:
                spec.add_exclude(bodyname1=links[one].name, bodyname2=links[other].name)


def _add_contact_sensors(spec: Any, robot: RobotModel, *, pairs: bool) -> None:
    """Add a sensor of the smallest distance for each pair of links, or one sensor that counts all contacts.

    Both see the state at the beginning of a step.
    """
    kind, fields = mujoco.mjtSensor.mjSENS_CONTACT, mujoco.mjtConDataField
    if not pairs:
        sensor = spec.add_sensor(type=kind, name="contacts")
        sensor.intprm = [1 << fields.mjCONDATA_FOUND.value, 0, 1]
        return
    body, nearest = mujoco.mjtObj.mjOBJ_BODY, 1
    for one, other in link_pairs(robot):
        sensor = spec.add_sensor(
            type=kind,
            objtype=body,
            objname=f"link {one}",
            reftype=body,
            refname=f"link {other}",
        )
        sensor.intprm = [1 << fields.mjCONDATA_DIST.value, nearest, 1]


def _add_shape(spec: Any, body: Any, geometry: pin.GeometryObject, shape: Shape) -> None:
    """Add a shape where Pinocchio's geometry object is."""
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
                uservert=_with_volume(mesh.hull.vertices).ravel(),
                inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,  # unused, but MuJoCo computes one
            )
            options = {"type": kinds.mjGEOM_MESH, "meshname": geometry.name}
    body.add_geom(
        name=geometry.name,
        solref=(2.0 * spec.option.timestep, _CONTACT_DAMPING),
        solimp=_CONTACT_IMPEDANCE,
        **options,
        **_placed(geometry.placement),
    )


def _with_volume(vertices: Floats) -> Floats:
    """The vertices (V, 3), m, of a shape; where it is flat, of one a little thicker, because MuJoCo needs a volume."""
    _, lengths, directions = np.linalg.svd(vertices - vertices.mean(axis=0), full_matrices=False)
    for length, direction in zip(lengths, directions, strict=True):
        if length <= 1e-9 * lengths[0]:
            vertices = np.concatenate([vertices - _THIN * direction, vertices + _THIN * direction])
    return vertices


def _add_body(parent: Any, inertia: pin.Inertia, **options: Any) -> Any:
    return parent.add_body(
        mass=inertia.mass,
        ipos=inertia.lever,
        fullinertia=inertia.inertia[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)],
        explicitinertial=True,
        **options,
    )


def _placed(placement: pin.SE3) -> dict[str, list[float]]:
    """A placement as MuJoCo's keyword arguments: position, and quaternion [w, x, y, z]."""
    *position, x, y, z, w = pin.SE3ToXYZQUAT(placement).tolist()
    return {"pos": position, "quat": [w, x, y, z]}
