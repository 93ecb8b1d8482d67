"""The examples run, each against the real library, as a user calls them."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from stable_baselines3 import PPO

from gym_mara.agents.sb3 import MaraVecEnv
from gym_mara.envs import MaraVectorEnv
from tests.helpers import ENV_IDS

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).parents[1] / "examples"
CALLS = {
    "behaviour_cloning.py --episodes 8 --evaluate 4": "success",
    "reach_from_pixels.py --minutes 0.05 --arms 4 --evaluate 1": "| the tool |",
    "sb3_ppo.py --way single": "position error",
    "sb3_ppo.py --way in_turn": "position error",
    "sb3_ppo.py --way in_processes": "position error",
    "sb3_ppo.py --way native": "position error",
    "hindsight_replay.py": "return of an episode",
    "cleanrl_ppo.py": "reward per step",
    "cleanrl_ppo.py --env-id gym_mara/MARARandomTarget-v0": "reward per step",
    "skrl_ppo.py": "reward per step",
    "rsl_rl_ppo.py --device cpu --arms 8": "position error",
    "torchrl_ppo.py": "reward per step",
    "tianshou_ppo.py": "reward per step",
    "sbx_ppo.py": "position error",
}
ELSEWHERE = {"rllib_ppo.py"}
"""What `make test-rllib` runs, in an environment of its own."""
ZOO = "--env gym_mara/MARA-v0 --gym-packages gym_mara --n-timesteps 600 --log-folder logs"


def test_no_example_is_forgotten() -> None:
    scripts = {path.name for path in EXAMPLES.glob("*.py")}
    assert scripts == {call.split()[0] for call in CALLS} | ELSEWHERE


@pytest.mark.parametrize("call", CALLS)
def test_an_example_runs(call: str, tmp_path: Path) -> None:
    script, *arguments = call.split()
    length = () if "--minutes" in arguments else ("--steps", "300")
    printed = _run(str(EXAMPLES / script), *arguments, *length, cwd=tmp_path)
    assert CALLS[call] in printed


def test_a_policy_from_pixels_is_one_of_stable_baselines3(tmp_path: Path) -> None:
    """It is loaded without the example, and goes on to learn from rewards."""
    script = str(EXAMPLES / "reach_from_pixels.py")
    _run(*f"{script} --minutes 0.02 --arms 2 --evaluate 1 --out a.zip".split(), cwd=tmp_path)
    model = PPO.load(tmp_path / "a.zip", device="cpu")
    camera = model.policy_kwargs["features_extractor_kwargs"]["camera"]
    arms = MaraVectorEnv(
        2,
        "MARAReach-v0",
        observation="joints+pixels",
        pixel_camera=camera,
        pixel_size=model.observation_space["depth"].shape[:2],  # type: ignore[index]
        pixel_channels=["rgb", "depth"],
        autoreset_mode="SameStep",
    )
    env = MaraVecEnv(arms)
    actions, _ = model.predict(env.reset(), deterministic=True)  # type: ignore[arg-type] # a dictionary
    assert actions.shape == (2, 6)
    assert np.ptp(actions, axis=0).max() > 0.0, "what it sees matters"
    PPO.load(tmp_path / "a.zip", env, device="cpu").learn(8)
    env.close()


def test_a_library_that_is_too_old_is_named_with_the_version_wanted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stale = tmp_path / "skrl-1.0.0.dist-info"
    stale.mkdir()
    (stale / "METADATA").write_text("Metadata-Version: 2.1\nName: skrl\nVersion: 1.0.0\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    done = _done(str(EXAMPLES / "skrl_ppo.py"), cwd=tmp_path)
    assert done.returncode != 0
    assert "skrl>=2.0" in done.stderr
    assert "1.0.0 is installed" in done.stderr


# TRPO goes the way of ACKTR.
@pytest.mark.parametrize("algo", ["ppo", pytest.param("trpo", marks=pytest.mark.nightly), "acktr"])
def test_the_zoo_trains_and_plays(algo: str, tmp_path: Path) -> None:
    folder = EXAMPLES / "rl_zoo3"
    zoo = ["-m", "rl_zoo3.train"] if algo == "ppo" else [str(folder / "zoo.py"), "train"]
    _run(*zoo, *f"--algo {algo} {ZOO} --conf-file {folder / algo}.yml".split(), cwd=tmp_path)
    played = f"enjoy --algo {algo} --env gym_mara/MARA-v0 -f logs --no-render -n 100"
    _run(str(folder / "zoo.py"), *played.split(), cwd=tmp_path)


@pytest.mark.parametrize("algo", ["ppo", "trpo", "acktr"])
def test_the_zoo_knows_the_papers_four_environments(algo: str) -> None:
    known = yaml.safe_load((EXAMPLES / "rl_zoo3" / f"{algo}.yml").read_text())
    assert set(known) == set(ENV_IDS)


def test_a_backend_from_another_package_passes_the_contract(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package, site = tmp_path / "lag_backend", tmp_path / "site"
    shutil.copytree(EXAMPLES / "lag_backend", package)  # building leaves files in the source
    pip = "-m pip install -q --no-deps --no-build-isolation --disable-pip-version-check --target"
    _run(*pip.split(), str(site), str(package), cwd=tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(site))
    assert "lag" in _run("-m", "gym_mara.cli", "list", cwd=tmp_path)
    train = "train --env MARA-v0 --backend lag --steps 512 --out run"
    _run("-m", "gym_mara.cli", *train.split(), cwd=tmp_path)
    page = (EXAMPLES.parent / "docs" / "add_a_backend.md").read_text(encoding="utf-8")
    [script] = [
        b for b in re.findall(r"^```python\n(.*?)^```", page, re.M | re.S) if "gymnasium.make(" in b
    ]
    _run("-c", script, cwd=tmp_path)
    tests = ("-m", "pytest", "-q", "-p", "no:cacheprovider", str(package))
    assert " passed" in _run(*tests, cwd=tmp_path)


def _done(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Python, called with these arguments, once it has ended."""
    return subprocess.run(
        [sys.executable, *arguments],
        check=False,
        capture_output=True,
        text=True,
        cwd=cwd,
        timeout=300,
    )


def _run(*arguments: str, cwd: Path) -> str:
    """What Python prints with these arguments; it must end well."""
    done = _done(*arguments, cwd=cwd)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
