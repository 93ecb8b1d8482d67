"""Warp's kernels that move arms without dynamics: the paths of PinocchioBackend, which end where an arm first collides.

A gain of zero stands for joints without servos.
"""

import warp as wp

from gym_mara.backends.warp.kernels import place_followers, servo_motion

_ROUNDING = wp.constant(1e-6)


@wp.kernel(enable_backward=False)
def plan_path(
    start_q: wp.array2d[float],
    target: wp.array2d[float],
    furthest: wp.array[float],
    reach: wp.array[float],
    initial: float,
    resolution: float,
    samples: wp.array[int],
    stopped: wp.array[int],
):
    """In how many samples each arm's path of one control period is checked for collisions.

    At their initial velocity joints move `initial` times their way in a period, but not further than `furthest`.
    """
    arm = wp.tid()
    length = float(0.0)
    for joint in range(furthest.shape[0]):
        way = wp.abs(target[arm, joint] - start_q[arm, joint])
        length += wp.min(initial * way, furthest[joint]) * reach[joint]
    samples[arm] = wp.max(1, int(wp.ceil(length / resolution)))
    stopped[arm] = 0


@wp.kernel(enable_backward=False)
def travel(
    start_q: wp.array2d[float],
    target: wp.array2d[float],
    furthest: wp.array[float],
    velocity: wp.array[float],
    gain: float,
    period: float,
    samples: wp.array[int],
    sample: int,
    stopped: wp.array[int],
    leader: wp.array[int],
    multiplier: wp.array[float],
    offset: wp.array[float],
    qpos: wp.array2d[float],
):
    """Move each arm to a sample of its path, or to its end; one that stopped stays."""
    arm = wp.tid()
    if stopped[arm] != 0:
        return
    part = float(wp.min(sample, samples[arm])) / float(samples[arm])
    for joint in range(furthest.shape[0]):
        way = target[arm, joint] - start_q[arm, joint]
        most = furthest[joint] * part
        if gain > 0.0:
            moved = servo_motion(way, gain, velocity[joint], period * part)
            low, high = (
                wp.min(start_q[arm, joint], target[arm, joint]),
                wp.max(start_q[arm, joint], target[arm, joint]),
            )
            qpos[arm, joint] = wp.clamp(start_q[arm, joint] + moved, low, high)
        elif wp.abs(way) <= most * (1.0 + _ROUNDING):
            qpos[arm, joint] = target[arm, joint]  # exactly, without rounding
        else:
            qpos[arm, joint] = start_q[arm, joint] + wp.clamp(way, -most, most)
    place_followers(qpos, arm, furthest.shape[0], leader, multiplier, offset)


@wp.kernel(enable_backward=False)
def stop(hit: wp.array[int], touching: wp.array[int], stopped: wp.array[int]):
    """Stop the arms that collide and did not touch anything before."""
    arm = wp.tid()
    if hit[arm] != 0 and touching[arm] == 0:
        stopped[arm] = 1


@wp.kernel(enable_backward=False)
def arrive(
    start_q: wp.array2d[float],
    target: wp.array2d[float],
    velocity: wp.array[float],
    gain: float,
    hit: wp.array[int],
    stopped: wp.array[int],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    touching: wp.array[int],
    steps: wp.array[int],
):
    """End a control period without dynamics: the velocities after it."""
    arm = wp.tid()
    steps[arm] = steps[arm] + 1
    touching[arm] = hit[arm]
    for joint in range(velocity.shape[0]):
        way = target[arm, joint] - start_q[arm, joint]
        if stopped[arm] != 0 or qpos[arm, joint] == target[arm, joint]:
            qvel[arm, joint] = 0.0
        elif gain > 0.0:
            wanted = gain * (target[arm, joint] - qpos[arm, joint])
            qvel[arm, joint] = wp.clamp(wanted, -velocity[joint], velocity[joint])
        else:
            qvel[arm, joint] = wp.sign(way) * velocity[joint]
