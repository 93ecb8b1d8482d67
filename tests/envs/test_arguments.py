"""The numbers, flags and names that the constructors take. The arguments are read from their signatures and fields."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable
from functools import partial
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest

from gym_mara.backends import Backend, backend_names
from gym_mara.backends.dart import DartBackend
from gym_mara.backends.pinocchio import PinocchioBackend
from gym_mara.backends.randomisation import PARAMETERS
from gym_mara.compat.gym_gazebo2 import GazeboMaraEnv
from gym_mara.envs import MaraEnv, MaraGoalEnv, MaraGoalVectorEnv, MaraVectorEnv
from gym_mara.envs.sensors import SensorSettings
from gym_mara.errors import GymMaraError
from gym_mara.rendering import RenderSettings
from gym_mara.tasks import ReachTask
from gym_mara.tasks.random_reach import RandomReachTask
from tests.helpers import robot_model


def _pinocchio(**settings: Any) -> PinocchioBackend:
    return PinocchioBackend(robot_model("mara"), 1, **settings)


def _dart(**settings: Any) -> DartBackend:
    return DartBackend(robot_model("mara"), 1, **settings)


# What is made, and the callable whose arguments it takes.
CONSTRUCTORS: dict[str, tuple[Callable[..., Any], Any]] = {
    "MaraEnv": (MaraEnv, MaraEnv),
    "MaraVectorEnv": (MaraVectorEnv, MaraVectorEnv),
    "MaraGoalEnv": (MaraGoalEnv, MaraGoalEnv),
    "MaraGoalVectorEnv": (MaraGoalVectorEnv, MaraGoalVectorEnv),
    "GazeboMaraEnv": (GazeboMaraEnv, GazeboMaraEnv),
    "PinocchioBackend": (_pinocchio, PinocchioBackend),
    "DartBackend": (_dart, DartBackend),
    "ReachTask": (ReachTask, ReachTask),
    "RandomReachTask": (RandomReachTask, RandomReachTask),
    "SensorSettings": (SensorSettings, SensorSettings),
    "RenderSettings": (RenderSettings, RenderSettings),
}


def _arguments(*kinds: type) -> list[Any]:
    """The constructors' arguments with one of these types, as parameters of a test: how to make it, the name, its default."""
    found = []
    for label, (make, form) in CONSTRUCTORS.items():
        function = form.__init__
        hints = get_type_hints(function)
        for parameter in inspect.signature(function).parameters.values():
            if issubclass(form, Backend) and parameter.kind is not parameter.KEYWORD_ONLY:
                continue  # the environment has checked them
            hint = hints.get(parameter.name)
            if hint in kinds or set(kinds) & set(get_args(hint)):
                found.append(pytest.param(make, parameter.name, id=f"{label}-{parameter.name}"))
    assert found
    return found


NO_NUMBERS = [True, np.True_, 1j, np.complex64(1.0), "1", b"1", np.nan, [1.0, 2.0], np.ones(2), {}]
TOO_LARGE = [1e300, 10**400, 10**5000, -1, 0 - 1e-300, np.inf, -np.inf, np.float64(1e300)]
# Velocity needs real_speed, and these have an error of their own without it.
TOGETHER: dict[str, dict[str, Any]] = {"velocity": {"real_speed": True}}


def _make(make: Callable[..., Any], name: str, value: Any) -> None:
    """Make an object with an argument, and release it."""
    made = make(**{name: value}, **TOGETHER.get(name, {}))
    if hasattr(made, "close"):
        made.close()


@pytest.mark.parametrize("value", [*NO_NUMBERS, *TOO_LARGE], ids=lambda v: str(type(v).__name__))
@pytest.mark.parametrize(("make", "name"), _arguments(int, float))
def test_what_is_no_number_or_too_large_is_refused(
    make: Callable[..., Any], name: str, value: Any
) -> None:
    with pytest.raises(GymMaraError, match=re.escape(name)):
        _make(make, name, value)


@pytest.mark.parametrize("value", [np.int64(1), np.int16(1), np.array(1)], ids=["64", "16", "0-d"])
@pytest.mark.parametrize(("make", "name"), _arguments(int))
def test_whole_numbers_of_numpy_are_accepted(
    make: Callable[..., Any], name: str, value: Any
) -> None:
    _make(make, name, value)


@pytest.mark.parametrize(
    "value", [np.float32(0.5), np.float64(0.5), np.array(0.5), np.float16(0.5)], ids=str
)
@pytest.mark.parametrize(("make", "name"), _arguments(float))
def test_numbers_of_numpy_are_accepted(make: Callable[..., Any], name: str, value: Any) -> None:
    if name == "physics_step":  # it must divide the control period, and be short
        value = np.asarray(value) / 128
        make = partial(make, control_period=1 / 64)
    _make(make, name, value)


@pytest.mark.parametrize(("make", "name"), _arguments(bool))
def test_flags_are_bools_of_python_or_numpy(make: Callable[..., Any], name: str) -> None:
    if name != "gui":  # opens a viewer
        _make(make, name, np.True_)
    _make(make, name, np.False_)
    for value in (1, 0.0, "yes", None, np.ones(2, np.bool_)):
        with pytest.raises(GymMaraError, match=f"{name} must be True or False"):
            _make(make, name, value)


@pytest.mark.parametrize("value", [3, ["coal"], np.array(["coal", "fcl"]), b"coal", "no such name"])
@pytest.mark.parametrize(("make", "name"), _arguments(str))
def test_names_that_do_not_exist_are_refused(
    make: Callable[..., Any], name: str, value: Any
) -> None:
    if name == "viewer_host" and isinstance(value, str):
        _make(make, name, value)  # any text can be an address
        return
    with pytest.raises(GymMaraError):
        _make(make, name, value)


VECTORS: list[Any] = [
    (ReachTask, "target_position", [0.1, 0.2, 0.9]),
    (ReachTask, "target_quaternion", [1, 0, 0, 0]),
    (ReachTask, "start_q", [0] * 6),
    (RandomReachTask, "start_q", [0] * 6),
]


@pytest.mark.parametrize(("task", "name", "values"), VECTORS)
def test_vectors_are_lists_or_arrays_of_finite_numbers(
    task: Any, name: str, values: list[float]
) -> None:
    for good in (values, tuple(values), np.array(values), np.array(values, np.float32)):
        np.testing.assert_allclose(getattr(task(**{name: good}), name), values, rtol=1e-6)
    wrong: list[Any] = [[str(v) for v in values], [bool(v) for v in values], np.array(values) * 1j]
    wrong += [[1e300] * len(values), [10**400] * len(values), [np.nan] * len(values), [[0.0]]]
    for bad in [*wrong, 1.0, "text", [values, values[1:]]]:
        with pytest.raises(GymMaraError, match=f"{name} must be a list of"):
            task(**{name: bad})


def test_every_vector_of_the_tasks_is_tested() -> None:
    vectors = {field.name for field in dataclasses.fields(ReachTask) if "tuple" in str(field.type)}
    assert vectors == {name for _, name, _ in VECTORS}


@pytest.mark.parametrize("parameter", PARAMETERS)
@pytest.mark.parametrize(
    "ends",
    [("0.5", "1"), (True, True), (0.5j, 1j), (0.5, 1e300), (0.5, 10**400), (2.0, 1.0), (-1.0, 1.0)],
    ids=str,
)
def test_a_range_that_is_not_of_numbers_in_order_is_refused(parameter: str, ends: Any) -> None:
    with pytest.raises(GymMaraError, match=rf"randomisation of '{parameter}' must be \(lowest"):
        _dart(randomisation={parameter: ends})


def test_ranges_can_be_arrays() -> None:
    env = MaraEnv(backend="dart", randomisation={"mass": np.array([0.5, 1.5], np.float32)})
    env.reset(seed=0)
    env.close()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_envs": 10**12}, "num_envs must be at most 1048576, because the arms of .*memory"),
        ({"num_envs": 20_000, "backend": "dart"}, "num_envs must be at most 16384, because"),
        ({"num_envs": 70_000, "backend": "mujoco"}, "num_envs must be at most 65536, because"),
        ({"threads": 10**6, "backend": "mujoco"}, "threads must be at most .*, because"),
        ({"num_envs": 10**19}, "num_envs must be at most 9007199254740992, because"),
        ({"control_period": 1e9}, r"control_period must be at most 1000 \(s\), because"),
        ({"control_period": 1e-7}, r"control_period must be at least 1e-06 \(s\), because"),
        (
            {"control_period": 1.0, "physics_step": 1e-6, "backend": "dart"},
            "must have at most 10000 physics steps, because",
        ),
        ({"physics_step": 1e-9, "backend": "dart"}, "must have at most 10000 physics steps"),
        ({"path_resolution": 1e-9, "max_joint_velocity": 1.0}, "path_resolution must be at least"),
        ({"collision_threads": 10**6}, "collision_threads must be at most 256, because"),
        (
            {"num_envs": 8192, "workers": 8192, "backend": "dart"},
            "workers must be at most .*, because each is a process",
        ),
        (
            {"backend": "dart", "randomisation": {"latency": (0.0, 1e6)}},
            "latency must be at most 1000 control periods .*because",
        ),
        ({"max_episode_steps": 10**400}, "max_episode_steps must be at most .*, because"),
        ({"robot": ["base", *["motor_large"] * 100_000, "tool"]}, "at most 50 modules"),
        ({"width": 5000}, "width must be at most 4096, because"),
        ({"alpha": 1e-300}, "alpha must be at least 0.001, because the reward"),
    ],
)
def test_a_bound_is_named_with_its_reason(options: dict[str, Any], message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        MaraVectorEnv(**options)


@pytest.mark.parametrize("alpha", [1e-3, 1e3])
@pytest.mark.parametrize("kappa", [1e-3, 1e3])
@pytest.mark.parametrize("beta", [1e-3, 1e2])
def test_the_reward_is_accurate_at_the_bounds(alpha: float, kappa: float, beta: float) -> None:
    env = MaraEnv("MARACollisionOrient-v0", alpha=alpha, kappa=kappa, beta=beta, gamma=0.0)
    env.reset()
    for q in (np.zeros(6), np.full(6, 0.5), np.full(6, 2.0)):
        _, reward, _, _, info = env.step(q.astype(np.float32))
        assert np.isfinite(reward)
        # Written with the smallest terms first, it is 11 at the target and 0 at 1 m.
        d, steep = info["distance"], np.longdouble(alpha)
        exact = sum(
            height * np.exp(-a * d) * np.expm1(a * (d - 1)) / np.expm1(-a)
            for height, a in ((1.0, steep), (10.0, steep / np.longdouble(kappa)))
        )
        assert info["reward_distance"] == pytest.approx(float(exact), abs=1e-8)


# Keyword arguments that no part knows.


@pytest.mark.parametrize(
    ("make", "name", "similar"),
    [
        (MaraEnv, "robt", "robot"),
        (MaraEnv, "backand", "backend"),
        (MaraEnv, "eeframe", "ee_frame"),
        (MaraEnv, "rendermode", "render_mode"),
        (MaraVectorEnv, "tsk", "task"),
        (MaraVectorEnv, "numenvs", "num_envs"),
        (MaraVectorEnv, "autoreset", "autoreset_mode"),
        (MaraVectorEnv, "max_episode_step", "max_episode_steps"),
        (MaraGoalEnv, "reward_typ", "reward_type"),
        (MaraGoalVectorEnv, "position_tolerence", "position_tolerance"),
        (GazeboMaraEnv, "real_sped", "real_speed"),
    ],
)
def test_the_error_for_a_misspelt_keyword_names_the_right_one(
    make: Any, name: str, similar: str
) -> None:
    with pytest.raises(GymMaraError, match=rf"Did you mean '{similar}'\? Valid: .*\b{similar}\b"):
        make(**{name: 1})


@pytest.mark.parametrize("name", ["physics_step", "detector", "randomisation", "workers"])
def test_a_keyword_of_another_backend_names_that_backend(name: str) -> None:
    assert "dart" in backend_names()
    message = f"'{name}' with backend 'pinocchio': it is a setting of the backend 'dart'; pass"
    with pytest.raises(GymMaraError, match=message):
        MaraEnv(**{name: 1})  # type: ignore[arg-type]
