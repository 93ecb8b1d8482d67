"""One arm in its own DART world: built from a RobotModel, moved by velocity servos, with its contacts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from gym_mara.backends.dart.shapes import Detector
from gym_mara.backends.servo_motion import has_diverged
from gym_mara.collision.base import CollisionChecker, NoChecker
from gym_mara.collision.coal import CoalChecker
from gym_mara.extras import needs
from gym_mara.robot import RobotModel
from gym_mara.state import Contact
from gym_mara.types import Floats

with needs("the backend 'dart'", "dart"):
    import dartpy as dart

GRAVITY = 9.81
"""m/s², downwards."""
LOOK_AHEAD = 0.01
"""The duration of a block of physics steps for which contacts are ruled out at once, s."""
# DART needs a mass for every body, even for a link welded to a body that already has the mass of both; kg and kg·m².
_NO_INERTIA = pin.Inertia(1e-9, np.zeros(3), 1e-9 * np.eye(3))
_REACHED = 1e-6
"""A joint this close to its commanded velocity, rad/s (m/s), has reached it; DART is accurate to 1e-8."""


class DartArm:
    """A robot on its base, in a world with gravity.

    Args:
        robot: the arm.
        physics_step: s.
        detector: the collision detector, one of `DETECTORS`; None for a world without collisions.
        velocity_limit: of the joints (J,), rad/s; None for the robot's.
        like: an arm of the same robot and settings, with which it shares what has no state.
        servo: whether motors move the joints, up to end stops at their limits; without both the arm falls freely.

    Raises:
        GymMaraError: the detector is unknown, or DART does not know a shape of the robot.
    """

    def __init__(
        self,
        robot: RobotModel,
        physics_step: float = 1e-3,
        detector: str | None = "fcl",
        *,
        velocity_limit: Floats | None = None,
        like: DartArm | None = None,
        servo: bool = True,
    ) -> None:
        self.robot = robot
        self.physics_step = physics_step
        self.skeleton = dart.dynamics.Skeleton(robot.name)
        self.bodies = self._build_bodies()
        joints = [body.getParentJoint() for body in self.bodies[1:]]
        self._joints, followers = joints[: robot.num_joints], joints[robot.num_joints :]
        speed = robot.velocity_limit if velocity_limit is None else velocity_limit
        if servo:
            for joint, low, high in zip(self._joints, robot.lower, robot.upper, strict=True):
                joint.setActuatorType(dart.dynamics.SERVO)
                joint.setPositionLowerLimit(0, low)
                joint.setPositionUpperLimit(0, high)
                joint.setLimitEnforcement(True)
            self.set_parameters()
        # They are driven along: contacts do not hold them back, nor act on the joints that they mimic.
        for joint in followers:
            joint.setActuatorType(dart.dynamics.VELOCITY)
        self._command = self._command_all if followers else self.skeleton.setCommands
        self._detector: Detector | None = None
        if detector is not None:
            self._detector = like._detector if like else Detector(detector, robot)
        self._build_shapes()
        self.world = self._new_world()
        self.world.addSkeleton(self.skeleton)
        self._forbid_contacts()
        # The same arm in a world without collision detection, which is most of what a step costs.
        self._free_world = self._new_world()
        self._free_world.addSkeleton(self.skeleton)
        for world in (self.world, self._free_world):
            world.getConstraintSolver().getCollisionGroup().setAutomaticUpdate(False)
        self._free_world.getConstraintSolver().getCollisionGroup().removeAllShapeFrames()
        self._block = max(1, round(LOOK_AHEAD / physics_step))
        self._commanded = np.zeros(robot.num_joints)
        self._speed, self._fastest = speed, 1.05 * speed
        within_block = 1.25 * speed * self._block * physics_step
        self._clearance: CollisionChecker = NoChecker(robot)
        if self._detector is not None:
            self._clearance = like._clearance if like else CoalChecker(robot, within_block)

    def _build_bodies(self) -> list[Any]:
        """A body for the base and one for each joint, in Pinocchio's order and frames."""
        model = self.robot.model
        bodies = [self.skeleton.createWeldJointAndBodyNodePair()[1]]
        _set_inertia(bodies[0], pin.Inertia(1.0, np.zeros(3), np.eye(3)))
        for number in range(1, model.njoints):
            linear, angular = np.split(self.robot.motion(number), 2)
            parent = bodies[model.parents[number]]
            if angular.any():
                properties = dart.dynamics.RevoluteJointProperties()
                create = parent.createRevoluteJointAndBodyNodePair
            else:
                properties = dart.dynamics.PrismaticJointProperties()
                create = parent.createPrismaticJointAndBodyNodePair
            properties.mName = model.names[number]
            properties.mAxis = angular if angular.any() else linear
            properties.mT_ParentBodyToJoint = _isometry(model.jointPlacements[number])
            joint, body = create(properties)
            inertia = model.inertias[number]
            if number <= self.robot.num_joints:
                joint.setDampingCoefficient(0, model.damping[number - 1])
            elif inertia.mass <= 0.0:
                inertia = _NO_INERTIA
            _set_inertia(body, inertia)
            bodies.append(body)
        return bodies

    def _build_shapes(self) -> None:
        """The shapes of each link, on a body with the name of the link."""
        if self._detector is None:
            return
        links: dict[str, Any] = {}
        unnamed = dict(enumerate(self.bodies))
        for index, geometry_object in enumerate(self.robot.geometry.geometryObjects):
            link, number = self.robot.link_of(index), geometry_object.parentJoint
            if link not in links:
                # The first link of a joint is the joint's body; others are welded to it, so that contacts name the link.
                body = unnamed.pop(number, None)
                if body is None:
                    body = self.bodies[number].createWeldJointAndBodyNodePair()[1]
                    _set_inertia(body, _NO_INERTIA)
                body.setName(link)
                links[link] = body
            for shape, placement in self._detector.shapes[index]:
                node = links[link].createShapeNode(shape)
                node.createCollisionAspect()
                node.createDynamicsAspect()
                node.setRelativeTransform(_isometry(geometry_object.placement * placement))
        self.skeleton.enableSelfCollisionCheck()
        self.skeleton.enableAdjacentBodyCheck()

    def _forbid_contacts(self) -> None:
        """Exclude the pairs of links that may not collide."""
        self._option = self.world.getConstraintSolver().getCollisionOption()
        named = [b for b in self.skeleton.getBodyNodes() if b.getNumShapeNodes()]
        for index, one in enumerate(named):
            for other in named[:index]:
                pair = frozenset((one.getName(), other.getName()))
                if pair not in self.robot.collision_pairs:
                    self._option.collisionFilter.addBodyNodePairToBlackList(one, other)

    def _new_world(self) -> Any:
        """An empty world with gravity."""
        world = dart.simulation.World()
        world.setTimeStep(self.physics_step)
        world.setGravity([0.0, 0.0, -GRAVITY])
        if self._detector is not None:
            world.setCollisionDetector(self._detector.engine)
        # DART must not deactivate an arm at rest: it would no longer follow small commands.
        deactivation = world.getDeactivationOptions()
        deactivation.mEnabled = False
        world.setDeactivationOptions(deactivation)
        return world

    def set_parameters(
        self,
        mass: Floats | float = 1.0,
        effort_limit: Floats | float = 1.0,
        joint_friction: Floats | float | None = None,
        contact_friction: float = 1.0,
    ) -> None:
        """Set the physical parameters in which this arm differs from its model.

        Args:
            mass: scale of the mass and inertia of each joint's body (J,).
            effort_limit: scale of each motor's effort limit (J,).
            joint_friction: Coulomb friction of each joint (J,), Nm; None for the URDF's.
            contact_friction: coefficient of friction of all surfaces.
        """
        model, count = self.robot.model, self.robot.num_joints
        friction = model.friction if joint_friction is None else joint_friction
        self._effort = effort = np.broadcast_to(effort_limit * self.robot.effort_limit, count)
        mass, friction = np.broadcast_to(mass, count), np.broadcast_to(friction, count)
        for index, (joint, body) in enumerate(
            zip(self._joints, self.bodies[1 : 1 + count], strict=True)
        ):
            joint.setForceLowerLimit(0, -effort[index])
            joint.setForceUpperLimit(0, effort[index])
            joint.setCoulombFriction(0, friction[index])
            own = model.inertias[index + 1]
            scale = mass[index]
            _set_inertia(body, pin.Inertia(scale * own.mass, own.lever, scale * own.inertia))
        for body in self.skeleton.getBodyNodes():
            for shape in body.getShapeNodes():
                shape.getDynamicsAspect().setFrictionCoeff(float(contact_friction))

    def reset(self, q: Floats) -> None:
        """Put the arm at rest at q (J,), rad."""
        self.set_state(q, np.zeros_like(q))

    def set_state(self, q: Floats, qd: Floats) -> None:
        """Put the arm at q, rad, with velocities qd, rad/s; both (J,)."""
        followers = self.robot.followers
        self.skeleton.setPositions(np.append(q, [each.position(q) for each in followers]))
        self.skeleton.setVelocities(np.append(qd, [each.velocity(qd) for each in followers]))
        self.skeleton.resetAccelerations()
        self.skeleton.resetCommands()
        self.skeleton.clearConstraintImpulses()

    @property
    def q(self) -> Floats:
        """Joint positions (J,), rad."""
        return np.asarray(self.skeleton.getPositions())[: self.robot.num_joints]

    @property
    def qd(self) -> Floats:
        """Joint velocities (J,), rad/s."""
        return np.asarray(self.skeleton.getVelocities())[: self.robot.num_joints]

    @property
    def followers(self) -> Floats:
        """Positions and velocities of the joints that follow others (2, F), rad and rad/s; they lag in a jam."""
        state = self.skeleton.getPositions(), self.skeleton.getVelocities()
        return np.array(state)[:, self.robot.num_joints :]

    @followers.setter
    def followers(self, state: Floats) -> None:
        for index, (q, qd) in enumerate(state.T.tolist(), self.robot.num_joints):
            self.skeleton.setPosition(index, q)
            self.skeleton.setVelocity(index, qd)

    @property
    def torque(self) -> Floats:
        """What the motors exerted in the last physics step (J,), Nm."""
        # DART adds what end stops and contacts exert. A motor that does not reach its commanded velocity exerts all it can.
        effort, missing = self._effort, self._commanded - self.qd
        forces = np.clip(self.skeleton.getConstraintForces()[: len(effort)], -effort, effort)
        return np.where(np.abs(missing) > _REACHED, np.copysign(effort, missing), forces)

    def run(self, velocities: Floats) -> tuple[Contact, ...]:
        """One physics step for each row of commanded joint velocities (K, J), rad/s; the contacts in any of them.

        Contacts are computed only in a block of steps in which links could touch. No joint is faster in it than 1.25
        times its limit: it starts with at most 1.05 times, and gravity adds little in such a short time, even where a
        motor is too weak to hold the arm.
        """
        deepest: dict[tuple[str, str], float] = {}
        self._commanded = velocities[-1]
        for start in range(0, len(velocities), self._block):
            block = velocities[start : start + self._block]
            if self.may_touch():
                if has_diverged(self.q, self.qd, self._speed):
                    break
                self._run_with_contacts(block, deepest)
            else:
                command, step = self._command, self._free_world.step
                for velocity in block:
                    command(velocity)
                    step()
        return tuple(Contact(links, depth) for links, depth in sorted(deepest.items()))

    def _command_all(self, velocities: Floats) -> None:
        """Command the velocities of the motors (J,), rad/s, for one physics step, and those of the joints that follow."""
        count, step = self.robot.num_joints, self.physics_step
        q = self.skeleton.getPositions()
        after = q[:count] + step * velocities
        wanted = [each.position(after) for each in self.robot.followers]
        speed = [abs(each.velocity(self._fastest)) for each in self.robot.followers]
        follow = np.clip((wanted - q[count:]) / step, np.negative(speed), speed)
        self.skeleton.setCommands(np.append(velocities, follow))

    def contacts(self) -> tuple[Contact, ...]:
        """The contacts at the current state."""
        deepest: dict[tuple[str, str], float] = {}
        self._run_with_contacts(np.empty((0, 0)), deepest)
        return tuple(Contact(links, depth) for links, depth in sorted(deepest.items()))

    def may_touch(self) -> bool:
        """Whether any links could touch within the next block of steps."""
        q, qd = self.q, self.qd
        slow = np.count_nonzero(np.abs(qd) <= self._fastest) == len(qd)  # not if it is NaN
        return bool(not slow or self._clearance.check(q[None])[0])

    def _run_with_contacts(self, velocities: Floats, deepest: dict[tuple[str, str], float]) -> None:
        # A detector keeps data from earlier steps. The order in which it reports contacts depends on them, and so do the
        # last bits of the solver's result. With a fresh detector the motion depends on the arm's state alone.
        group = self.world.getConstraintSolver().getCollisionGroup()
        group.removeAllShapeFrames()
        group.addShapeFramesOf(self.skeleton)
        command, step = self._command, self.world.step
        result = self.world.getLastCollisionResult
        for velocity in velocities:
            command(velocity)
            step()
            found = result()
            if found.isCollision():
                _note_contacts(found, deepest)
        # A step detects contacts before it moves, so those at the end of the last step are still unknown.
        if self.world.checkCollision(self._option, found := dart.collision.CollisionResult()):
            _note_contacts(found, deepest)


def _note_contacts(result: Any, deepest: dict[tuple[str, str], float]) -> None:
    """Enter the contacts of a result, for each pair of links the deepest."""
    for contact in result.getContacts():
        ends = (contact.collisionObject1, contact.collisionObject2)
        one, other = sorted(e.getShapeFrame().asShapeNode().getBodyNode().getName() for e in ends)
        depth = float(contact.penetrationDepth)
        deepest[one, other] = max(depth, deepest.get((one, other), 0.0))


def _isometry(placement: pin.SE3) -> Any:
    return dart.math.Isometry3(placement.homogeneous)


def _set_inertia(body: Any, inertia: pin.Inertia) -> None:
    body.setInertia(dart.dynamics.Inertia(inertia.mass, inertia.lever, inertia.inertia))
