"""The backend "warp": MuJoCo Warp moves thousands of arms on a GPU of NVIDIA, with dynamics or without."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gym_mara.backends.base import Backend, limited_velocity
from gym_mara.backends.servo import ON_DIVERGENCE, made_again, simulation_diverged
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
from gym_mara.types import Floats, Mask

with needs("the backend 'warp'", "warp"):
    pass  # the libraries are imported for the first arm, because they take seconds

if TYPE_CHECKING:
    import torch

    from gym_mara.backends.warp.engine import Engine

ARRAYS = ("numpy", "torch")
_UNLIMITED = 1.0
"""The velocity for the bounds of a joint without limit that teleports, rad/s (m/s)."""


class WarpBackend(Backend):
    """Thousands of arms on one GPU, in single precision.

    With dynamics the motors are position servos, as those of the backends "dart" and "mujoco". Without, joints move as in
    the backend "pinocchio": they reach their targets within a step, or with `max_joint_velocity` they travel, and an arm
    stops where its path first collides.

    The same arms on the CPU compute the same numbers to the bit. On a GPU MuJoCo Warp adds up the forces of constraints in
    the order in which its threads happen to end, so that two runs differ by rounding.

    Args:
        robot: the arm.
        num_envs: the number of arms.
        control_period: s.
        dynamics: whether masses and forces count; False for kinematics with collisions, which is faster.
        physics_step: s; a control period is a whole number of them.
        max_joint_velocity: rad/s (m/s), where it is below the URDF's limits. None for those; without dynamics, for joints
            that reach their targets within a step.
        servo_gain: 1/s.
        on_divergence: what follows when an arm's state diverges: "error", or "truncate" to end the arm's episode.
        arrays: "numpy", or "torch" for tensors on the device, whose values are never copied to the host. Contacts are not
            reported then, and on a GPU an error may come a few steps late.
        device: "cuda", "cuda:1" and so on; "cpu" for tests; None for the first GPU.
        max_contacts: the room for contacts of each arm; a contact has several points. More of them exert no force.

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
        servo_gain: float = 10.0,
        on_divergence: str = "error",
        arrays: str = "numpy",
        device: str | None = None,
        max_contacts: int = 24,
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
        }
        self.on_divergence = one_of("on_divergence", on_divergence, ON_DIVERGENCE)
        self.arrays = one_of("arrays", arrays, ARRAYS)
        self._max_contacts = whole_number("max_contacts", max_contacts, at_most=1000)
        self._physics_step = positive_number("physics_step", physics_step, "s")
        self._servo_gain = positive_number("servo_gain", servo_gain, "1/s")
        self.overshoot = 0.01
        if max_joint_velocity is not None:
            self.joint_velocity = limited_velocity(robot, max_joint_velocity)
        if self.dynamic:
            step_times(self.control_period, self._physics_step)
        else:
            # Limits in single precision may be this much beyond those of the robot.
            self.overshoot = float(np.spacing(np.float32(np.abs([robot.lower, robot.upper]).max())))
            self.teleports = max_joint_velocity is None
            limit = self.joint_velocity
            self.joint_velocity = np.where(limit < LARGEST, limit, _UNLIMITED)
        self._kinematics = robot.kinematics()
        self._engine = self._new_engine(device)
        self._fresh = False
        """Whether the arrays of the engine are those of the current state."""
        self._told_of_contacts = False
        self.reset(self.asarray(np.tile(robot.home, (num_envs, 1))))

    def _new_engine(self, device: str | None) -> Engine:
        with needs("the backend 'warp'", "warp"):
            from gym_mara.backends.warp.device import choose_device
            from gym_mara.backends.warp.engine import Engine

            if self.arrays == "torch":
                import torch  # noqa: F401 - an error here, not in the first step
        self._on = choose_device(device)
        if self.arrays == "torch":
            self.device = str(self._on.alias)
        with self._scope():
            return Engine(
                self.robot,
                self.num_envs,
                self._on,
                control_period=self.control_period,
                physics_step=self._physics_step if self.dynamic else None,
                servo_gain=self._servo_gain,
                joint_velocity=self.joint_velocity,
                teleports=self.teleports,
                max_contacts=self._max_contacts,
                by_pair=self.arrays == "numpy",
            )

    @contextmanager
    def _scope(self) -> Iterator[None]:
        """Let Warp work on the device, and in the current stream of torch if the arrays are tensors."""
        import warp as wp

        with ExitStack() as stack:
            stack.enter_context(wp.ScopedDevice(self._on))
            if self.arrays == "torch" and self._on.is_cuda:
                import torch

                stream = torch.cuda.current_stream(wp.device_to_torch(self._on))
                stack.enter_context(wp.ScopedStream(wp.stream_from_torch(stream)))
            yield

    @property
    def bytes_per_arm(self) -> int:
        """How much memory of the device an arm takes, about."""
        return self._engine.bytes_per_arm

    def asarray(self, values: ArrayLike) -> Any:
        array = np.asarray(values)
        if self.arrays == "torch":
            import torch

            dtype = torch.bool if array.dtype == np.bool_ else torch.float32
            return torch.as_tensor(array, dtype=dtype, device=self.device)
        return array if array.dtype == np.bool_ else array.astype(np.float64, copy=False)

    def reset(self, q: Floats, mask: Mask | None = None) -> None:
        engine = self._engine
        with self._scope():
            self._give("q", q, engine.target)
            if mask is None:
                engine.mask.fill_(True)
            else:
                self._give("mask", mask, engine.mask)
            engine.put_at_rest()
        self._fresh = False

    def step(self, q_target: Floats) -> SimState:
        with self._scope():
            self._give("q_target", q_target, self._engine.target)
            self._engine.step()
        self._fresh = True
        state = self._read()
        self._check_status()
        return state

    def _give(self, name: str, values: Any, array: Any) -> None:
        """Copy values that a caller gives to an array of the engine."""
        import warp as wp

        if self.arrays == "numpy":
            if not isinstance(values, np.ndarray):
                raise self._foreign(name, values)
            array.assign(values.astype(wp.dtype_to_numpy(array.dtype), copy=False))
            return
        import torch

        if not isinstance(values, torch.Tensor) or values.device != torch.device(str(self.device)):
            raise self._foreign(name, values)
        own = wp.to_torch(array)
        own.copy_(values)

    def _foreign(self, name: str, values: Any) -> GymMaraError:
        own = "arrays of NumPy" if self.arrays == "numpy" else f"tensors of torch on {self.device}"
        where = f" on {values.device}" if hasattr(values, "device") else ""
        return GymMaraError(
            f"{name} is a {type(values).__module__}.{type(values).__name__}{where}; with arrays={self.arrays!r} the backend "
            f"'warp' takes {own}: convert it with the backend's asarray(values)"
        )

    @property
    def state(self) -> SimState:
        if not self._fresh:
            with self._scope():
                self._engine.look_at_arms()
            self._fresh = True
        state = self._read()
        self._check_status()
        return state

    def _read(self) -> SimState:
        """The state in the arrays of the engine."""
        engine = self._engine
        read: Callable[[Any], Any] = self._read_tensor if self.arrays == "torch" else _read_numbers
        truncates = self.dynamic and self.on_divergence == "truncate"
        common: dict[str, Any] = {
            "q": read(engine.q),
            "qd": read(engine.qd),
            "collided": read(engine.collided),
            "torque": read(engine.torque) if self.dynamic else None,
            "diverged": read(engine.diverged) if truncates else None,
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

    def _read_tensor(self, array: Any) -> torch.Tensor:
        """A copy of an array of the engine, on the device."""
        import warp as wp

        tensor: torch.Tensor = wp.to_torch(array)
        return tensor.clone()

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
        diverged, without_force, lost = (int(status[i]) for i in (DIVERGED, NO_FORCE, LOST))
        with self._scope():
            self._engine.clear_status()
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
                stacklevel=3,
            )
        if diverged and self.on_divergence == "error":
            time = float(self._engine.steps.numpy()[diverged - 1]) * self.control_period
            raise simulation_diverged(diverged - 1, time)

    def save(self) -> dict[str, Any]:
        return {name: array.numpy().copy() for name, array in self._engine.state.items()}

    def restore(self, snapshot: dict[str, Any]) -> None:
        check_fits("backend", snapshot, self.save())
        with self._scope():
            for name, array in self._engine.state.items():
                array.assign(snapshot[name])
        self._fresh = False

    def __reduce__(self) -> tuple[Any, ...]:
        return made_again, (type(self), self.robot, self.num_envs, self._settings, self.save())


def _read_numbers(array: Any) -> NDArray[Any]:
    """A copy of an array of the engine, on the host, with numbers in double precision."""
    values: NDArray[Any] = array.numpy()
    return values.copy() if values.dtype == np.bool_ else values.astype(np.float64)
