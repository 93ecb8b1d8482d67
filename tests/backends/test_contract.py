"""The contract of a backend, over every backend and several robots, and over FakeBackend."""

from __future__ import annotations

from typing import Any, NamedTuple

import pytest

from gym_mara.backends import make_backend, simulated_backends
from gym_mara.robot import RobotModel
from gym_mara.testing import BackendContract, Make
from tests.helpers import DEVICES, MODULAR_ARMS, robot_model, write

# A cart on a rail with an arm of two joints, which reach a post at the end of the rail, and the rail itself.
RAIL = """
<robot name="rail">
  <link name="rail">
    <collision><geometry><box size="1.6 0.1 0.1"/></geometry></collision>
    <collision><origin xyz="0.9 0 0.4"/><geometry><box size="0.1 0.4 0.8"/></geometry></collision>
  </link>
  <joint name="slide" type="prismatic"><parent link="rail"/><child link="cart"/>
    <origin xyz="0 0 0.12"/><axis xyz="1 0 0"/>
    <limit lower="-0.6" upper="0.7" effort="300" velocity="0.8"/></joint>
  <link name="cart"><inertial><mass value="3"/>
    <inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><box size="0.12 0.12 0.1"/></geometry></collision></link>
  <joint name="shoulder" type="revolute"><parent link="cart"/><child link="upper"/>
    <origin xyz="0 0 0.1"/><axis xyz="0 1 0"/>
    <limit lower="-2.2" upper="2.2" effort="60" velocity="1.5"/></joint>
  <link name="upper"><inertial><origin xyz="0 0 0.2"/><mass value="1"/>
    <inertia ixx="0.02" iyy="0.02" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 0 0.2"/>
      <geometry><cylinder radius="0.04" length="0.4"/></geometry></collision></link>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/>
    <origin xyz="0 0 0.45"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="30" velocity="2"/></joint>
  <link name="lower"><inertial><origin xyz="0 0 0.15"/><mass value="0.5"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 0 0.15"/><geometry><sphere radius="0.05"/></geometry></collision></link>
</robot>
"""


class Case(NamedTuple):
    """A backend, its settings, and the robot that it moves."""

    backend: str
    settings: dict[str, Any] = {}  # noqa: RUF012 - never changed
    robot: str = "mara"


RANDOM = {
    "mass": (0.8, 1.2),
    "servo_gain": (0.7, 1.3),
    "latency": (0.0, 0.05),
    "sensor_noise": (0.0, 1e-3),
}
TRAVELLING = {"max_joint_velocity": 1.0}
SERVOS = {"servo_gain": 10.0}
# Two physics steps, because each takes long on a CPU; and room for arms that random poses put deep into the table.
WARP = DEVICES["warp"] | {"control_period": 0.008, "physics_step": 0.004, "max_contacts": 96}
OTHER_ROBOTS = ("3 joints", "7 joints", "rail")
CASES = {
    **{name: Case(name) for name in simulated_backends()},
    "fake": Case("fake"),
    "warp": Case("warp", WARP),
    "warp, kinematic": Case("warp", WARP | {"dynamics": False}),
    "warp, travelling": Case("warp", WARP | {"max_joint_velocity": 1.5, "dynamics": False}),
    "warp, servos": Case("warp", WARP | SERVOS | {"dynamics": False}),
    "warp, random": Case("warp", WARP | {"randomisation": RANDOM, "on_divergence": "truncate"}),
    "warp, rail": Case("warp", WARP | {"physics_step": 0.002}, "rail"),
    "pinocchio, travelling": Case("pinocchio", TRAVELLING),
    "pinocchio, servos": Case("pinocchio", SERVOS),
    "pinocchio, servos, rail": Case("pinocchio", SERVOS, "rail"),
    "pinocchio, fcl": Case("pinocchio", {"collision": "fcl"}),
    "pinocchio, threads": Case("pinocchio", {"collision_threads": 2}),
    "dart, random": Case(
        "dart", {"randomisation": RANDOM, "on_divergence": "truncate", "workers": 1}
    ),
    **{f"pinocchio, {robot}": Case("pinocchio", {}, robot) for robot in OTHER_ROBOTS},
    **{
        f"pinocchio, travelling, {robot}": Case("pinocchio", TRAVELLING, robot)
        for robot in OTHER_ROBOTS
    },
    "mujoco, threads": Case("mujoco", {"threads": 2}),
    "mujoco, random": Case("mujoco", {"randomisation": RANDOM, "on_divergence": "truncate"}),
    **{f"dart, {robot}": Case("dart", {"workers": 1}, robot) for robot in OTHER_ROBOTS},
    **{f"mujoco, {robot}": Case("mujoco", {}, robot) for robot in OTHER_ROBOTS},
}


@pytest.fixture(scope="session")
def robots(tmp_path_factory: pytest.TempPathFactory) -> dict[str, RobotModel]:
    """The robots of the cases by name."""
    rail = write(tmp_path_factory.mktemp("rail") / "rail.urdf", RAIL)
    return {
        "mara": robot_model("mara"),
        "3 joints": RobotModel.from_modules(MODULAR_ARMS[3]),
        "7 joints": RobotModel.from_modules(MODULAR_ARMS[7]),
        "rail": RobotModel.from_urdf(rail, ee_frame="lower"),
    }


@pytest.fixture(params=CASES.values(), ids=list(CASES))
def make(request: pytest.FixtureRequest, robots: dict[str, RobotModel], fake_backend: str) -> Make:
    """Makes the backend of a case for N arms."""
    case: Case = request.param
    return lambda num_envs: make_backend(case.backend, robots[case.robot], num_envs, case.settings)


class TestContract(BackendContract):
    """The suite that authors of other backends use."""
