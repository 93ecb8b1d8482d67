"""The backend "warp": MuJoCo Warp moves thousands of arms on a GPU of NVIDIA, with dynamics or without."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gym_mara.backends.base import Backend, limited_velocity, stated_velocity
from gym_mara.backends.randomisation import Randomisation
from gym_mara.backends.servo import ON_DIVERGENCE, late_periods, made_again, simulation_diverged
from gym_mara.backends.servo_motion import step_times
from gym_mara.errors import (
    LARGEST,
    GymMaraError,
    flag,
    one_of,
    positive_number,
    whole_number,
)
from gym_mara.extras import needs
from gym_mara.robot import RobotModel
from gym_mara.snapshots import check_fits
from gym_mara.state import Contact, SimState
from gym_mara.types import Array, Floats, Mask

with needs("the backend 'warp'", "warp"):
    pass  # the libraries are imported for the first arm, because they take seconds

if TYPE_CHECKING:
    from gym_mara.backends.warp.engine import Engine
    from gym_mara.backends.warp.exchange import NumpyExchange

ARRAYS = ("numpy", "torch")
SERVO_GAIN = 10.0
"""The gain of servos with dynamics, 1/s: that of the other dynamic backends."""
OF_MODEL = frozenset(("mass", "effort_limit", "joint_friction", "contact_friction"))
"""The parameters that the model on the device has; the servos and the sensors have the others."""


class WarpBackend(Backend):
    """Thousands of arms on one GPU, in single precision.

    With dynamics the motors are position servos, as those of the backends "dart" and "mujoco". Without, joints move as in
    the backend "pinocchio": they reach their targets within a step, or with `max_joint_velocity` they travel, or with
    `servo_gain` they follow the law of the servos, and an arm stops where its path first collides.

    The same arms on the CPU compute the same numbers to the bit. On a GPU MuJoCo Warp adds up the forces of constraints in
    the order in which its threads happen to end, so that two runs differ by rounding.

    Args:
        robot: the arm.
        num_envs: the number of arms.
        control_period: s.
        dynamics: whether masses and forces count; False for kinematics with collisions, which is faster.
        physics_step: s; a control period is a whole number of them.
        max_joint_velocity: rad/s (m/s), where it is below the URDF's limits. None for those; without dynamics and
            `servo_gain`, for joints that reach their targets within a step.
        servo_gain: 1/s. None for SERVO_GAIN; without dynamics, for joints without servos.
        on_divergence: what follows when an arm's state diverges: "error", or "truncate" to end the arm's episode.
        arrays: "numpy", or "torch" for tensors on the device, whose values are never copied to the host. Contacts are not
            reported then, and on a GPU an error may come a few steps late.
        device: "cuda", "cuda:1" and so on; "cpu" for tests; None for the first GPU.
        max_contacts: the room for points of contact of each arm; more of them exert no force.
        randomisation: name → (lowest, highest), drawn for each arm at the beginning of each episode; see
            `gym_mara.backends.randomisation`.

    Raises:
        GymMaraError: a setting is out of its range, the device has too little memory, MuJoCo Warp cannot simulate the
            robot, or there is no GPU.
        SimulationDivergedError: from `step`, where an arm's state diverges and `on_divergence` is "error".
    """

    dynamic = True
    precision = np.float32

    def __init__(
        self,
        robot: RobotModel,
        num_envs: int,
        *,
        control_period: float = 0.02,
        dynamics: bool = True,
        physics_step: float = 0.002,
        max_joint_velocity: float | None = None,
        servo_gain: float | None = None,
        on_divergence: str = "error",
        arrays: str = "numpy",
        device: str | None = None,
        max_contacts: int = 24,
        randomisation: Mapping[str, Sequence[float]] | None = None,
    ) -> None:
        self.dynamic = flag("dynamics", dynamics)
        super().__init__(robot, num_envs, control_period=control_period)
        self._settings: dict[str, Any] = {
            "control_period": control_period,
            "dynamics": dynamics,
            "physics_step": physics_step,
            "max_joint_velocity": max_joint_velocity,
            "servo_gain": servo_gain,
            "on_divergence": on_divergence,
            "arrays": arrays,
            "device": device,
            "max_contacts": max_contacts,
            "randomisation": randomisation,
        }
        self.on_divergence = one_of("on_divergence", on_divergence, ON_DIVERGENCE)
        self.arrays = one_of("arrays", arrays, ARRAYS)
        self._max_contacts = whole_number("max_contacts", max_contacts, at_most=1000)
        self._physics_step = positive_number("physics_step", physics_step, "s")
        if self.dynamic or servo_gain is not None:
            gain = SERVO_GAIN if servo_gain is None else servo_gain
            self.servo_gain = positive_number("servo_gain", gain, "1/s")
        self.overshoot = 0.01
        if max_joint_velocity is not None:
            self.joint_velocity = limited_velocity(robot, max_joint_velocity)
        if self.dynamic:
            step_times(self.control_period, self._physics_step)
        else:
            # Limits in single precision may be this much beyond those of the robot.
            self.overshoot = float(np.spacing(np.float32(np.abs([robot.lower, robot.upper]).max())))
            self.teleports = max_joint_velocity is None and servo_gain is None
            if not self.teleports:
                self.joint_velocity = limited_velocity(robot, max_joint_velocity)
            unlimited = self.joint_velocity >= LARGEST
            if servo_gain is not None and unlimited.any():
                raise GymMaraError(
                    f"joint {robot.joint_names[int(unlimited.argmax())]} of {robot.name} has no velocity limit, which its servo "
                    "needs without dynamics: give max_joint_velocity"
                )
            self.joint_velocity = stated_velocity(self.joint_velocity)
        self.randomisation = Randomisation({} if randomisation is None else randomisation, robot)
        self.random = bool(self.randomisation.ranges)
        if self.random and not self.dynamic:
            raise GymMaraError(
                "randomisation is of arms with dynamics: leave it out, or give dynamics=True"
            )
        self._parameters = {
            name: np.repeat(value[None], num_envs, axis=0)
            for name, value in self.randomisation.nominal().items()
        }
        self._kinematics = robot.kinematics()
        self._exchange: NumpyExchange
        self._engine = self._new_engine(device)
        self._fresh = False
        """Whether the arrays of the engine are those of the current state."""
        self._told_of_contacts = False
        self._apply_parameters(range(num_envs))
        self.reset(self.asarray(np.tile(robot.home, (num_envs, 1))))

    @classmethod
    def require_machine(cls) -> None:
        from gym_mara.backends.warp.device import choose_device

        choose_device(None)

    def _new_engine(self, device: str | None) -> Engine:
        with needs("the backend 'warp'", "warp"):
            from gym_mara.backends.warp.device import choose_device
            from gym_mara.backends.warp.engine import Engine
            from gym_mara.backends.warp.exchange import make_exchange

            on = choose_device(device)
            self._exchange = make_exchange(self.arrays, on)
        if self.arrays == "torch":
            self.device = on.alias
        with self._exchange.scope():
            return Engine(
                self.robot,
                self.num_envs,
                on,
                control_period=self.control_period,
                physics_step=self._physics_step if self.dynamic else None,
                late_periods=late_periods(self.randomisation, self.control_period),
                joint_velocity=self.joint_velocity,
                teleports=self.teleports,
                servo_gain=None if self.dynamic else self.servo_gain,
                max_contacts=self._max_contacts,
                by_pair=self.arrays == "numpy",
                own_parameters=not OF_MODEL.isdisjoint(self.randomisation.ranges),
            )

    @property
    def bytes_per_arm(self) -> int:
        """How much memory of the device an arm takes, about."""
        return self._engine.bytes_per_arm

    def asarray(self, values: ArrayLike) -> Array:
        return self._exchange.asarray(values)

    def begin_episodes(self, seeds: NDArray[np.uint64], mask: Mask) -> None:
        arms = np.flatnonzero(mask).tolist()
        for arm in arms:
            for name, value in self.randomisation.draw(int(seeds[arm])).items():
                self._parameters[name][arm] = value
        self._apply_parameters(arms)

    def _apply_parameters(self, arms: Iterable[int]) -> None:
        """Copy the random parameters to the device, after those of these arms have changed."""
        own, engine = self._parameters, self._engine
        ones = np.ones((self.num_envs, self.robot.num_joints))
        latency = own.get("latency", np.zeros(self.num_envs))
        late = latency // self.control_period
        with self._exchange.scope():
            engine.gain.assign((self.servo_gain or 0.0) * own.get("servo_gain", ones))
            engine.late.assign(late.astype(np.int32))
            engine.change.assign(latency - late * self.control_period)
            if engine.parameters is None:
                return
            of_model = OF_MODEL & own.keys()
            for arm in arms:
                engine.parameters.set(arm, {name: own[name][arm] for name in of_model})
            engine.parameters.copy_to(engine.model)

    def reset(self, q: Floats, mask: Mask | None = None) -> None:
        engine = self._engine
        with self._exchange.scope():
            self._give("q", q, engine.target)
            if mask is None:
                engine.mask.fill_(True)
            else:
                self._give("mask", mask, engine.mask)
            engine.put_at_rest()
        self._fresh = False

    def step(self, q_target: Floats) -> SimState:
        with self._exchange.scope():
            self._give("q_target", q_target, self._engine.target)
            self._engine.step()
            self._fresh = True
            return self._read()

    def _give(self, name: str, values: Array, array: Any) -> None:
        """Copy values that a caller gives to an array of the engine."""
        exchange = self._exchange
        if not exchange.fits(values):
            where = f" on {values.device}" if hasattr(values, "device") else ""
            raise GymMaraError(
                f"{name} is a {type(values).__module__}.{type(values).__name__}{where}; with arrays={self.arrays!r} the "
                f"backend 'warp' takes {exchange.takes}: convert it with the backend's asarray(values)"
            )
        exchange.give(values, array)

    @property
    def state(self) -> SimState:
        with self._exchange.scope():
            if not self._fresh:
                self._engine.look_at_arms()
                self._fresh = True
            return self._read()

    def _read(self) -> SimState:
        """The state in the arrays of the engine; an error if something went wrong."""
        state = self._state_of_engine()
        self._check_status()
        return state

    def _state_of_engine(self) -> SimState:
        engine, read = self._engine, self._exchange.read
        truncates = self.dynamic and self.on_divergence == "truncate"
        common: dict[str, Any] = {
            "q": read(engine.q),
            "qd": read(engine.qd),
            "collided": read(engine.collided),
            "torque": read(engine.torque) if self.dynamic else None,
            "diverged": read(engine.diverged) if truncates else None,
            "parameters": {n: self.asarray(v.copy()) for n, v in self._parameters.items()} or None,
        }
        if self.arrays == "torch":
            return SimState(
                **common,
                ee_position=read(engine.position),
                ee_quaternion=read(engine.quaternion),
                ee_velocity=read(engine.velocity),
                time=read(engine.time),
            )
        position, quaternion = self._kinematics.pose(common["q"])
        return SimState(
            **common,
            ee_position=position,
            ee_quaternion=quaternion,
            ee_velocity=self._kinematics.velocity(common["q"], common["qd"]),
            time=engine.steps.numpy() * self.control_period,
            contacts=self._contacts(common["collided"]),
        )

    def _contacts(self, collided: Mask) -> tuple[tuple[Contact, ...], ...]:
        """The contacts of each arm in the last control period."""
        if not np.count_nonzero(collided):
            return ((),) * self.num_envs
        depth, pairs = self._engine.depth.numpy().astype(np.float64), self._engine.pairs
        contacts: list[tuple[Contact, ...]] = [()] * self.num_envs
        for arm in np.flatnonzero(collided).tolist():
            deepest = depth[arm].tolist()
            contacts[arm] = tuple(
                Contact(pairs[index], deepest[index])
                for index in np.flatnonzero(depth[arm] >= 0.0).tolist()
            )
        return tuple(contacts)

    def _check_status(self) -> None:
        """Report what went wrong; on a GPU that nobody waits for, in an earlier step."""
        from gym_mara.backends.warp.kernels import DIVERGED, LOST, NO_FORCE

        status = self._engine.status.numpy()
        if not np.count_nonzero(status):
            return
        status = self._engine.take_status()
        diverged, without_force, lost = (int(status[i]) for i in (DIVERGED, NO_FORCE, LOST))
        if lost:
            raise GymMaraError(
                f"{self.num_envs} arms have more contacts than max_contacts={self._max_contacts} for each has room for, and "
                "some were not seen: give a larger max_contacts"
            )
        if without_force and not self._told_of_contacts:
            self._told_of_contacts = True
            warnings.warn(
                f"arm {without_force - 1} had more than max_contacts={self._max_contacts} points of contact, and the rest "
                "exerted no force; a larger max_contacts takes more memory and time",
                stacklevel=4,
            )
        if diverged and self.on_divergence == "error":
            time = float(self._engine.steps.numpy()[diverged - 1]) * self.control_period
            raise simulation_diverged(diverged - 1, time)

    def save(self) -> dict[str, Any]:
        with self._exchange.scope():
            engine = {name: array.numpy().copy() for name, array in self._engine.state.items()}
        return engine | {"parameters": copy.deepcopy(self._parameters)}

    def restore(self, snapshot: dict[str, Any]) -> None:
        check_fits("backend", snapshot, self.save())
        with self._exchange.scope():
            for name, array in self._engine.state.items():
                array.assign(snapshot[name])
        self._parameters = copy.deepcopy(snapshot["parameters"])
        self._apply_parameters(range(self.num_envs))
        self._fresh = False

    def __reduce__(self) -> tuple[Any, ...]:
        return made_again, (type(self), self.robot, self.num_envs, self._settings, self.save())
