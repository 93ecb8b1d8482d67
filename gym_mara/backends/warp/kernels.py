"""Warp's kernels around those of MuJoCo Warp: servos, contacts, resets, and the report of a state.

N is the number of arms, J that of the robot's joints, F that of the joints that follow others, D that of the latest targets. Positions of MuJoCo's joints
(N, J + F) begin with those of the robot. All lengths are in m, angles in rad, times in s.
"""

import mujoco
import warp as wp
from mujoco_warp import OverflowType

from gym_mara.backends.servo_motion import DIVERGED_VELOCITY
from gym_mara.rotations import ZERO

# Indices of the status, which is the same for all arms.
DIVERGED, NO_FORCE, LOST = 0, 1, 2
"""The number of an arm, from 1, whose state has diverged; of one with contacts that exert no force; whether contacts were lost."""
NO_CONTACT = -1.0
"""The depth of a pair of links that do not touch."""

_FRICTION_TENDON = wp.constant(int(mujoco.mjtConstraint.mjCNSTR_FRICTION_TENDON))
_LOST_BITS = wp.constant(int(OverflowType.BROADPHASE | OverflowType.NARROWPHASE | OverflowType.CCD))
_NO_FORCE_BIT = wp.constant(int(OverflowType.NEFC))
_DIVERGED = wp.constant(DIVERGED)
_NO_FORCE = wp.constant(NO_FORCE)
_LOST = wp.constant(LOST)
_NO_CONTACT = wp.constant(NO_CONTACT)
_DIVERGED_VELOCITY = wp.constant(DIVERGED_VELOCITY)
_ZERO = wp.constant(ZERO)


@wp.func
def servo_motion(way: float, gain: float, limit: float, time: float) -> float:
    """How far a joint has moved: `gym_mara.backends.servo_motion.servo_motion` for a number."""
    distance = wp.abs(way)
    slow_way = wp.min(distance, limit / gain)
    fast = wp.min(time, (distance - slow_way) / limit)
    slow = slow_way * (wp.exp(gain * (fast - time)) - 1.0)
    return wp.sign(way) * (fast * limit - slow)


@wp.func
def _late_servo_motion(
    q: float, old: float, new: float, gain: float, limit: float, time: float, change: float
) -> float:
    """`gym_mara.backends.servo_motion.late_servo_motion` for numbers."""
    before = servo_motion(old - q, gain, limit, wp.min(time, change))
    after = wp.max(time - change, 0.0)
    return before + servo_motion(new - (q + before), gain, limit, after)


@wp.kernel(enable_backward=False)
def begin(
    target: wp.array2d[float],
    targets: wp.array3d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    warmstart: wp.array2d[float],
    start_q: wp.array2d[float],
    start_qd: wp.array2d[float],
    start_warmstart: wp.array2d[float],
    depth: wp.array2d[float],
    hit: wp.array[int],
    looking: wp.array[int],
):
    """Begin a control period: keep the latest targets and the state before it, and forget the contacts of the last one."""
    arm = wp.tid()
    newest = targets.shape[1] - 1
    for joint in range(target.shape[1]):
        for index in range(newest):
            targets[arm, index, joint] = targets[arm, index + 1, joint]
        targets[arm, newest, joint] = target[arm, joint]
    for joint in range(qpos.shape[1]):
        start_q[arm, joint] = qpos[arm, joint]
        start_qd[arm, joint] = qvel[arm, joint]
        start_warmstart[arm, joint] = warmstart[arm, joint]
    for pair in range(depth.shape[1]):
        depth[arm, pair] = _NO_CONTACT
    hit[arm] = 0
    looking[arm] = 1


@wp.kernel(enable_backward=False)
def command(
    start_q: wp.array2d[float],
    targets: wp.array3d[float],
    late: wp.array[int],
    change: wp.array[float],
    gain: wp.array2d[float],
    limit: wp.array[float],
    time: float,
    physics_step: float,
    qvel: wp.array2d[float],
    efc_type: wp.array2d[int],
    efc_id: wp.array2d[int],
    nefc: wp.array[int],
    aref: wp.array2d[float],
):
    """Command the motors the velocity that the servos have planned for the physics step that begins at a time."""
    arm, row = wp.tid()
    if row >= nefc[arm] or efc_type[arm, row] != _FRICTION_TENDON:
        return
    joint = efc_id[arm, row]
    q, fastest, servo = start_q[arm, joint], limit[joint], gain[arm, joint]
    newest = targets.shape[1] - 1 - late[arm]
    old, new = targets[arm, newest - 1, joint], targets[arm, newest, joint]
    now = _late_servo_motion(q, old, new, servo, fastest, time, change[arm])
    then = _late_servo_motion(q, old, new, servo, fastest, time + physics_step, change[arm])
    velocity = (then - now) / physics_step
    aref[arm, row] = (velocity - qvel[arm, joint]) / physics_step


@wp.kernel(enable_backward=False)
def read_torque(
    efc_type: wp.array2d[int],
    efc_id: wp.array2d[int],
    nefc: wp.array[int],
    force: wp.array2d[float],
    torque: wp.array2d[float],
):
    """The torques (N, J) that the motors exerted in the last physics step."""
    arm, row = wp.tid()
    if row < nefc[arm] and efc_type[arm, row] == _FRICTION_TENDON:
        torque[arm, efc_id[arm, row]] = force[arm, row]


@wp.kernel(enable_backward=False)
def count_contacts(
    number: wp.array[int],
    candidates: wp.array[int],
    arm_of: wp.array[int],
    geom: wp.array[wp.vec2i],
    distance: wp.array[float],
    pair_of: wp.array2d[int],
    looking: wp.array[int],
    depth: wp.array2d[float],
    hit: wp.array[int],
    status: wp.array[int],
):
    """Note which arms touch, and how deep each pair of links (N, P) at most, of those arms that are looked at."""
    contact = wp.tid()
    room = distance.shape[0]
    if contact == 0 and (number[0] > room or candidates[0] > room):
        status[_LOST] = 1
    if contact >= wp.min(number[0], room) or distance[contact] > 0.0:
        return
    arm = arm_of[contact]
    if looking[arm] == 0:
        return
    hit[arm] = 1
    if depth.shape[1] > 0:
        pair = pair_of[geom[contact][0], geom[contact][1]]
        wp.atomic_max(depth, arm, pair, -distance[contact])


@wp.kernel(enable_backward=False)
def judge(
    limit: wp.array[float],
    start_q: wp.array2d[float],
    start_qd: wp.array2d[float],
    start_warmstart: wp.array2d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    warmstart: wp.array2d[float],
    torque: wp.array2d[float],
    depth: wp.array2d[float],
    hit: wp.array[int],
    steps: wp.array[int],
    diverged: wp.array[wp.bool],
    overflow: wp.array[int],
    status: wp.array[int],
):
    """End a control period with dynamics: put arms whose state diverged back to where they were before it."""
    arm = wp.tid()
    steps[arm] = steps[arm] + 1
    sane = bool(True)
    for joint in range(qpos.shape[1]):
        sane = sane and wp.isfinite(qpos[arm, joint]) and wp.isfinite(qvel[arm, joint])
        sane = sane and wp.isfinite(warmstart[arm, joint])
        if joint < limit.shape[0]:
            sane = sane and wp.abs(qvel[arm, joint]) < _DIVERGED_VELOCITY * limit[joint]
    diverged[arm] = not sane
    if sane:
        return
    wp.atomic_max(status, _DIVERGED, arm + 1)
    hit[arm] = 0
    overflow[arm] = 0
    for pair in range(depth.shape[1]):
        depth[arm, pair] = _NO_CONTACT
    for joint in range(qpos.shape[1]):
        qpos[arm, joint] = start_q[arm, joint]
        qvel[arm, joint] = start_qd[arm, joint]
        warmstart[arm, joint] = start_warmstart[arm, joint]
    for joint in range(torque.shape[1]):
        torque[arm, joint] = 0.0


@wp.func
def place_followers(
    qpos: wp.array2d[float],
    arm: int,
    joints: int,
    leader: wp.array[int],
    multiplier: wp.array[float],
    offset: wp.array[float],
):
    """Put the joints that follow others where they belong."""
    for index in range(leader.shape[0]):
        qpos[arm, joints + index] = multiplier[index] * qpos[arm, leader[index]] + offset[index]


@wp.kernel(enable_backward=False)
def put_at_rest(
    mask: wp.array[wp.bool],
    q: wp.array2d[float],
    leader: wp.array[int],
    multiplier: wp.array[float],
    offset: wp.array[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    warmstart: wp.array2d[float],
    torque: wp.array2d[float],
    depth: wp.array2d[float],
    hit: wp.array[int],
    looking: wp.array[int],
    touching: wp.array[int],
    steps: wp.array[int],
    diverged: wp.array[wp.bool],
    targets: wp.array3d[float],
):
    """Put the arms of a mask at rest at q (N, J), to be looked at."""
    arm = wp.tid()
    if not mask[arm]:
        return
    for joint in range(q.shape[1]):
        qpos[arm, joint] = q[arm, joint]
        torque[arm, joint] = 0.0
        for index in range(targets.shape[1]):
            targets[arm, index, joint] = q[arm, joint]
    place_followers(qpos, arm, q.shape[1], leader, multiplier, offset)
    for joint in range(qvel.shape[1]):
        qvel[arm, joint] = 0.0
        warmstart[arm, joint] = 0.0
    for pair in range(depth.shape[1]):
        depth[arm, pair] = _NO_CONTACT
    hit[arm] = 0
    looking[arm] = 1
    touching[arm] = 0
    steps[arm] = 0
    diverged[arm] = False


@wp.func
def _multiply(a: wp.vec4, b: wp.vec4) -> wp.vec4:
    """The Hamilton product of quaternions [w, x, y, z]."""
    return wp.vec4(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@wp.func
def _canonical(q: wp.vec4) -> wp.vec4:
    """`gym_mara.rotations.canonical` for a quaternion."""
    sign = float(0.0)
    for index in range(4):
        if sign == 0.0 and wp.abs(q[index]) > _ZERO:
            sign = wp.sign(q[index])
    turned = wp.normalize(q) * sign
    return wp.vec4(wp.abs(turned[0]), turned[1], turned[2], turned[3])


@wp.kernel(enable_backward=False)
def report(
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    limit: wp.array[float],
    hit: wp.array[int],
    steps: wp.array[int],
    control_period: float,
    body: int,
    moving: int,
    place: wp.vec3,
    turn: wp.vec4,
    prismatic: wp.array[int],
    xpos: wp.array2d[wp.vec3],
    xquat: wp.array2d[wp.quat],
    xanchor: wp.array2d[wp.vec3],
    xaxis: wp.array2d[wp.vec3],
    looking: wp.array[int],
    overflow: wp.array[int],
    status: wp.array[int],
    q_out: wp.array2d[float],
    qd_out: wp.array2d[float],
    position_out: wp.array2d[float],
    quaternion_out: wp.array2d[float],
    velocity_out: wp.array2d[float],
    collided_out: wp.array[wp.bool],
    time_out: wp.array[float],
):
    """The fields of a state; the end effector is placed on a body that the first joints move."""
    arm = wp.tid()
    looking[arm] = 0
    if (overflow[arm] & _LOST_BITS) != 0:
        status[_LOST] = 1
    if (overflow[arm] & _NO_FORCE_BIT) != 0:
        wp.atomic_max(status, _NO_FORCE, arm + 1)
    overflow[arm] = 0
    collided_out[arm] = hit[arm] != 0
    time_out[arm] = float(steps[arm]) * control_period
    for joint in range(limit.shape[0]):
        q_out[arm, joint] = qpos[arm, joint]
        qd_out[arm, joint] = wp.clamp(qvel[arm, joint], -limit[joint], limit[joint])
    frame = xquat[arm, body]  # MuJoCo's order is w, x, y, z
    rotation = wp.vec4(frame[0], frame[1], frame[2], frame[3])
    inverse = wp.vec4(rotation[0], -rotation[1], -rotation[2], -rotation[3])
    lever = _multiply(_multiply(rotation, wp.vec4(0.0, place[0], place[1], place[2])), inverse)
    position = xpos[arm, body] + wp.vec3(lever[1], lever[2], lever[3])
    velocity = wp.vec3(0.0, 0.0, 0.0)
    for joint in range(moving):
        axis = xaxis[arm, joint]
        if prismatic[joint] == 0:
            axis = wp.cross(axis, position - xanchor[arm, joint])
        velocity += qd_out[arm, joint] * axis
    quaternion = _canonical(_multiply(rotation, turn))
    for index in range(3):
        position_out[arm, index] = position[index]
        velocity_out[arm, index] = velocity[index]
    for index in range(4):
        quaternion_out[arm, index] = quaternion[index]
