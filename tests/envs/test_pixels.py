"""Pictures as observations: the same for one arm and for many, with known depths and segments, and nothing wrong in silence."""

from __future__ import annotations

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.env_checker import check_env as check_with_sb3

from gym_mara.agents.training.train import preset_agent
from gym_mara.datasets.playing import record
from gym_mara.datasets.sources import baseline
from gym_mara.envs import MaraEnv, MaraGoalEnv, MaraVectorEnv
from gym_mara.envs.view import first_view, view_of
from gym_mara.errors import GymMaraError
from gym_mara.rendering.camera import VIEW_ANGLE, place_camera
from gym_mara.rendering.scene import Scene
from gym_mara.rendering.settings import CHANNELS, RenderSettings
from gym_mara.robot import RobotModel
from tests.helpers import write
from tests.robot import arms

SMALL: dict[str, Any] = {"pixel_size": 32, "max_joint_velocity": 1.5}
ALL: dict[str, Any] = {**SMALL, "observation": "state+pixels", "pixel_channels": CHANNELS}
RANDOM = {"light": 0.5, "colour": 0.3, "camera": 0.1}


def _equal(one: Any, other: Any) -> None:
    assert one.keys() == other.keys()
    for key, values in one.items():
        rounding = 1e-12 if key == "state" else 0.0
        np.testing.assert_allclose(values, other[key], rtol=0.0, atol=rounding, err_msg=key)


@pytest.mark.parametrize("observation", ["pixels", "state+pixels", "joints+pixels"])
@pytest.mark.parametrize("camera", ["top", "tool"])
def test_the_checkers_of_gymnasium_and_stable_baselines3_pass(
    observation: str, camera: str
) -> None:
    env = gymnasium.make(
        "gym_mara/MARAReach-v0", observation=observation, pixel_camera=camera, pixel_size=36
    )
    check_env(env.unwrapped, skip_render_check=True)
    check_with_sb3(env)
    env.close()


def test_pictures_alone_are_an_array_and_otherwise_part_of_a_dictionary() -> None:
    def space(**options: Any) -> Any:
        env = MaraEnv("MARAReach-v0", **options)
        env.close()
        return env.observation_space

    assert space(observation="pixels", pixel_size=(24, 40)) == Box(0, 255, (24, 40, 3), np.uint8)
    depth = space(observation="pixels", pixel_size=32, pixel_channels=["depth"])
    assert list(depth) == ["depth"]
    assert depth["depth"].shape == (32, 32, 1)
    whole, own = space(**ALL), space(observation="joints+pixels")
    assert isinstance(whole, Dict)
    assert set(whole) == {"state", "pixels", "depth", "segmentation"}
    assert whole["state"] == space(max_joint_velocity=1.5)
    assert own["state"].shape < whole["state"].shape, "without the target"


def test_the_camera_environment_of_gym_gazebo2_has_state_and_pictures() -> None:
    env = gymnasium.make("gym_mara/MARACamera-v0")
    observation, _ = env.reset(seed=0)
    state, _ = MaraEnv("MARA-v0").reset(seed=0)
    np.testing.assert_array_equal(observation["state"], state)
    assert observation["pixels"].shape == (84, 84, 3)
    env.close()


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("random", [None, RANDOM], ids=["usual", "random"])
def test_many_arms_see_what_single_ones_see(mode: str, random: Any) -> None:
    options = {**ALL, "pixel_randomisation": random, "max_episode_steps": 3}
    env_id = "gym_mara:gym_mara/MARAReach-v0"
    native = gymnasium.make_vec(env_id, num_envs=2, autoreset_mode=mode, **options)
    singles = gymnasium.make_vec(
        env_id,
        num_envs=2,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode(mode)},
        **options,
    )
    _equal(native.reset(seed=3)[0], singles.reset(seed=3)[0])
    generator = np.random.default_rng(0)
    for _ in range(5):
        actions = generator.uniform(-1.0, 1.0, (2, 6)).astype(np.float32)
        mine, theirs = native.step(actions), singles.step(actions)
        _equal(mine[0], theirs[0])
        if "final_obs" in mine[-1]:
            for one, other in zip(mine[-1]["final_obs"], theirs[-1]["final_obs"], strict=True):
                _equal(one, other)
    native.close()
    singles.close()


def test_episodes_look_different_if_they_are_random_and_steps_do_not() -> None:
    env = MaraEnv("MARA-v0", observation="pixels", pixel_randomisation=RANDOM, pixel_size=32)
    usual = MaraEnv("MARA-v0", observation="pixels", pixel_size=32)
    first, _ = env.reset(seed=0)
    second, _ = env.reset()
    assert np.abs(first.astype(int) - second).mean() > 5.0
    np.testing.assert_array_equal(env.step(np.zeros(6, np.float32))[0], second)
    np.testing.assert_array_equal(env.reset(seed=0)[0], first)
    np.testing.assert_array_equal(usual.reset(seed=0)[0], usual.reset()[0])


def test_many_arms_are_drawn_in_threads_as_in_one(monkeypatch: pytest.MonkeyPatch) -> None:
    env = MaraVectorEnv(20, "MARARandomTarget-v0", **{**ALL, "pixel_randomisation": RANDOM})
    seen, _ = env.reset(seed=0)
    monkeypatch.setattr("gym_mara.rendering.casting.batch_renderer._ARMS_PER_THREAD", 10**6)
    alone, _ = env.reset(seed=0)
    _equal(seen, alone)
    env.close()


def test_a_copy_and_a_restored_snapshot_see_the_same() -> None:
    env = MaraEnv("MARAReach-v0", **ALL, pixel_randomisation=RANDOM)
    env.reset(seed=0)
    snapshot, action = env.save_state(), np.ones(6, np.float32)
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    expected = env.step(action)[0]
    for other in copies:
        _equal(other.step(action)[0], expected)
    env.reset()
    env.restore_state(snapshot)
    _equal(env.step(action)[0], expected)


def test_threads_see_what_one_thread_sees() -> None:
    def pictures(seed: int) -> Any:
        env = MaraEnv("MARARandomTarget-v0", **{**SMALL, "observation": "pixels"})
        env.reset(seed=seed)
        return [env.step(np.full(6, 0.5, np.float32))[0] for _ in range(3)]

    with ThreadPoolExecutor(4) as threads:
        together = list(threads.map(pictures, range(4)))
    for seed, seen in enumerate(together):
        np.testing.assert_array_equal(seen, pictures(seed))


@pytest.mark.parametrize("robot", ["mara", "ur5"])
def test_they_agree_with_the_pictures_of_vtk(robot: str) -> None:
    env = MaraEnv(
        "MARAReach-v0",
        robot=robot,
        observation="pixels",
        render_mode="rgb_array",
        renderer="vtk",
        width=84,
        height=84,
    )
    seen, _ = env.reset(seed=1)
    drawn = env.render()
    assert drawn is not None
    apart = np.abs(seen.astype(int) - drawn)
    assert apart.mean() < 3.0
    assert (apart.max(axis=-1) > 40).mean() < 0.05
    env.close()


def test_depth_and_segments_are_those_of_known_points() -> None:
    """The frame of the target is where the kinematics of a pinhole camera say, and as far away."""
    size, found = 96, 0
    env = MaraVectorEnv(
        8, "MARAReach-v0", **{**ALL, "pixel_size": size, "pixel_channels": CHANNELS[1:]}
    )
    seen: Any = env.reset(seed=0)[0]
    segments, depths = seen["segmentation"][..., 0], seen["depth"][..., 0]
    simulation = env.simulation
    assert simulation.pixels is not None
    target = simulation.pixels.segments.index("target")
    settings = RenderSettings(width=size, height=size)
    camera = place_camera(Scene(simulation.robot), first_view(simulation), settings)
    forwards = (camera.at - camera.eye) / np.linalg.norm(camera.at - camera.eye)
    right = np.cross(forwards, camera.up)
    right /= np.linalg.norm(right)
    scale = size / 2.0 / np.tan(np.radians(VIEW_ANGLE / 2.0))
    for arm in range(8):
        way = view_of(simulation, arm).target_position - camera.eye
        depth = way @ forwards
        column = (size - 1.0) / 2.0 + scale * (way @ right) / depth
        row = (size - 1.0) / 2.0 - scale * (way @ np.cross(right, forwards)) / depth
        place = arm, round(row), round(column)
        around = arm, slice(place[1] - 1, place[1] + 2), slice(place[2] - 1, place[2] + 2)
        near = segments[around] == target
        if near.any():  # else it is behind the arm
            found += 1
            assert np.abs(depths[around][near] - depth).min() < 0.02
    assert found >= 5
    space: Any = env.single_observation_space
    assert depths.max() == space["depth"].high.max()
    env.close()


def test_a_camera_that_looks_at_a_point_before_it_sees_the_arm_nearer_than_the_background() -> None:
    eye = np.array([6.0, 0.0, 1.0])
    seen: list[Any] = []
    for at in (np.array([0.0, 0.0, 0.7]), eye + 0.01 * np.array([-6.0, 0.0, -0.3])):
        camera = {"pixel_camera": [eye.tolist(), at.tolist()], "pixel_channels": CHANNELS[1:]}
        env = MaraEnv("MARAReach-v0", robot="ur5", **{**ALL, **camera, "pixel_size": 64})
        seen.append(env.reset(seed=0)[0])
        env.close()
    on_arm = seen[0]["segmentation"] > 1
    np.testing.assert_array_equal(seen[1]["segmentation"] > 1, on_arm)
    np.testing.assert_allclose(seen[1]["depth"][on_arm], seen[0]["depth"][on_arm], atol=1e-5)


def test_a_link_may_have_the_name_of_a_frame(tmp_path: Path) -> None:
    """It is another segment than the frame, and does not carry the camera on the tool."""
    shape = '<visual><origin xyz="0.1 0 0"/><geometry><box size="0.1 0.1 0.2"/></geometry></visual>'
    seen: list[Any] = []
    names: list[tuple[str, ...]] = []
    for name in ("hand", "tool"):
        text = arms.arm(
            collision=f"{arms.COLLISION}{shape}", more=f'<link name="{name}">{shape}</link>'
        )
        text = text.replace('<link name="tool"/>', "").replace(
            '<child link="tool"/>', f'<child link="{name}"/>'
        )
        robot = RobotModel.load(str(write(tmp_path / f"{name}.urdf", text)), ee_frame="l2")
        env = MaraEnv("MARAReach-v0", robot=robot, pixel_camera="tool", **ALL)
        seen.append(env.reset(seed=0)[0])
        assert env.simulation.pixels is not None
        names.append(env.simulation.pixels.segments)
        env.close()
    _equal(*seen)
    assert [name.replace("hand", "tool") for name in names[0]] == list(names[1])
    assert names[1][-2:] == ("target", "tool")
    assert names[1].count("tool") == 2


def test_a_joint_that_mimics_another_is_seen_where_it_follows(tmp_path: Path) -> None:
    file = arms.arm_file(tmp_path, arms.arm(more=arms.FOLLOWER))
    env = MaraEnv("MARA-v0", robot=str(file), ee_frame=arms.TOOL, pixel_camera="side", **ALL)
    pixels, rows = env.simulation.pixels, []
    assert pixels is not None
    for j2 in (0.0, 1.8):  # the follower stands, then it hangs
        seen: Any = env.reset(seed=0, options={"start_q": [0.0, j2, 0.0]})[0]
        rows.append(np.nonzero(seen["segmentation"][..., 0] == pixels.segments.index("lf"))[0])
    assert rows[1].mean() > rows[0].mean() + 3.0
    env.close()


def test_arms_of_more_links_than_a_byte_can_number_have_pictures_without_segments(
    tmp_path: Path,
) -> None:
    box = '<visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual>'
    more = "".join(
        f'<link name="e{n}">{box}</link><joint name="f{n}" type="fixed"><parent link="base"/><child link="e{n}"/></joint>'
        for n in range(253)  # with nothing, floor, target and tool one too many
    )
    robot = RobotModel.load(arms.arm_file(tmp_path, arms.arm(more=more)), arms.TOOL)
    options = {**ALL, "robot": robot, "observation": "pixels"}
    env = MaraEnv("MARA-v0", **{**options, "pixel_channels": ["rgb"]})
    assert np.ptp(env.reset(seed=0)[0]) > 100
    env.close()
    with pytest.raises(GymMaraError, match=r"arm has 257 segments.*leave 'segmentation' out"):
        MaraEnv("MARA-v0", **options)


def test_a_camera_on_the_tool_that_sees_one_link_alone_says_where_it_looks(tmp_path: Path) -> None:
    box = '<visual><origin xyz="-0.1 0 -0.08"/><geometry><box size="0.1 0.1 0.1"/></geometry></visual>'
    text = arms.arm().replace('<link name="tool"/>', f'<link name="tool">{box}</link>')
    robot = RobotModel.load(arms.arm_file(tmp_path, text), arms.TOOL)
    with pytest.raises(GymMaraError, match=r"but 'tool'.*along z of .* 'tool'.*by ee_frame"):
        MaraEnv("MARA-v0", robot=robot, pixel_camera="tool", **ALL)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"observation": "images"}, r"observation.*state\+pixels"),
        ({"pixel_size": 32}, r"pixel_size has no effect.*observation='state\+pixels'"),
        ({**ALL, "pixel_size": 0}, r"pixel_size.*at least 1"),
        ({**ALL, "pixel_size": (32, 32, 3)}, r"a height and a width"),
        ({**ALL, "pixel_size": 4096}, r"pixel_size.*1024"),
        ({**ALL, "pixel_camera": "back"}, r"pixel_camera.*three_quarter, tool"),
        ({**ALL, "pixel_camera": [[0, 0, 1]]}, r"pixel_camera must be one of"),
        ({**ALL, "pixel_camera": [[3, 0, 1], [6, 0, 1]]}, r"sees neither the arm at home"),
        (
            {**ALL, "pixel_camera": [[0.6, 0.3, 0.62], [0.6, 1, 0.62]]},
            r"nothing but '.*': it is inside",
        ),
        ({**ALL, "pixel_channels": []}, r"pixel_channels must be a list of some of rgb"),
        ({**ALL, "pixel_channels": "rgb"}, r"pixel_channels must be a list of some of rgb"),
        ({**ALL, "pixel_channels": ["rgb", "infrared"]}, r"pixel_channels.*infrared"),
        ({**ALL, "pixel_channels": ["rgb", "rgb"]}, r"each channel once"),
        ({**ALL, "pixel_channels": [["rgb"]]}, r"pixel_channels"),
        ({**ALL, "pixel_channels": 5}, r"pixel_channels must be a list of some of rgb"),
        ({**ALL, "pixel_channels": None}, r"pixel_channels must be a list of some of rgb"),
        ({**ALL, "pixel_camera": None}, r"pixel_camera must be one of"),
        ({**ALL, "pixel_size": "large"}, r"pixel_size"),
        ({**ALL, "pixel_size": None}, r"pixel_size"),
        ({**ALL, "pixel_randomisation": {"light": "much"}}, r"light must be a number"),
        ({**ALL, "pixel_randomisation": {5: 0.1}}, r"pixel_randomisation"),
        ({"observation": ["pixels"]}, r"observation"),
        ({"pixel_size": np.array([32, 32])}, r"pixel_size has no effect"),
        ({**ALL, "pixel_randomisation": {"lights": 1.0}}, r"pixel_randomisation.*lights"),
        ({**ALL, "pixel_randomisation": {"light": 2.0}}, r"light must be a number from 0 to 1"),
        ({**ALL, "pixel_randomisation": {"light": np.nan}}, r"light must be a number from 0 to 1"),
        ({**ALL, "pixel_randomisation": 0.5}, r"a dictionary with some of light"),
    ],
)
def test_bad_settings_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        MaraEnv("MARA-v0", **options)


def test_what_cannot_take_pictures_says_so(tmp_path: Any) -> None:
    with pytest.raises(GymMaraError, match=r"observation must be 'state' or 'state\+pixels'"):
        MaraGoalEnv(observation="pixels")
    with pytest.raises(GymMaraError, match=r"not for pictures.*reach_from_pixels"):
        preset_agent("MARA-v0", observation="pixels")
    source = baseline("ik", "MARA-v0", "pinocchio", {"observation": "pixels"})
    with pytest.raises(GymMaraError, match=r"leave out observation='pixels'"):
        record(source, "minari", tmp_path / "pixels-v0", episodes=1)


def test_a_goal_environment_has_pictures_beside_its_goals() -> None:
    env = MaraGoalEnv(observation="state+pixels", pixel_size=32)
    observation, _ = env.reset(seed=0)
    assert set(observation) == {"observation", "achieved_goal", "desired_goal", "pixels"}
    assert env.observation_space.contains(observation)
    env.close()
