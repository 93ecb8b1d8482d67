"""A policy of Stable-Baselines3 that reaches the targets of MARAReach-v0 from pictures (RGB and depth) and joint states.

To learn from rewards alone takes too long on a CPU. Here a `MultiInputPolicy` imitates the package's pretrained policy, which knows
the target. Its layers first learn to act for known targets (DAgger: the teacher corrects the states that the student visits).
Then it learns where the target is, from pictures of what the student does, with the segmentation as labels.

    python examples/reach_from_pixels.py --out reacher.zip
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from gym_mara.agents.evaluation.metrics import METRICS, mean_in_short
from gym_mara.agents.runs.evaluation import measure_acting
from gym_mara.agents.sb3 import MaraVecEnv
from gym_mara.deploy import OnnxPolicy
from gym_mara.envs import make_vector_env
from gym_mara.pretrained import pretrained_file
from gym_mara.rendering.camera import VIEW_ANGLE
from gym_mara.robot import RobotModel
from gym_mara.tasks.observation import OF_THE_ROBOT

ENV = "MARAReach-v0"
CAMERA = [[-1.87, -1.0, 3.68], [0.0, 0.0, 1.15]]
OPTIONS: dict[str, Any] = {
    "observation": "joints+pixels",
    "pixel_camera": CAMERA,
    "pixel_size": 112,
    "pixel_channels": ["rgb", "depth"],
    "max_joint_velocity": 1.57,
    "servo_gain": 10,
}
PARTS = ("state", "pixels", "depth")
ACTOR_SHARE = 0.2
"""Of the time."""
STEPS, SKIPPED = 160, 20
"""Of an episode of the training, and between two pictures of it."""
KEPT_STATES, KEPT_PICTURES = 250_000, 16_384
LEARNING_RATE = 2e-3
MARKER, POINTS = 0.1, 40
"""About the size of the frame that marks a target, m, and how many pixels it is read from."""


def layers(*sizes: int) -> nn.Sequential:
    """Linear layers with ReLU between them."""
    linear = [nn.Linear(*pair) for pair in itertools.pairwise(sizes)]
    return nn.Sequential(*[part for one in linear for part in (one, nn.ReLU())][:-1])


class Reacher(BaseFeaturesExtractor):
    """What the policy knows: the joints, the tool, and the target, which it sees.

    The convolutions choose pixels that show the target. From the points in the world that these show, a PointNet says where it is.
    """

    rays: Tensor
    eye: Tensor

    def __init__(self, space: Any, camera: Any) -> None:
        self.joints = (space["state"].shape[0] - 3) // 5
        super().__init__(space, 6 * self.joints + 18)
        self.kinematics = RobotModel.load("mara").kinematics()
        height, width, _ = space["depth"].shape
        eye, at = np.array(camera)
        forwards = (at - eye) / np.linalg.norm(at - eye)
        right = np.cross(forwards, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rows, columns = np.mgrid[:height, :width] - (np.array([[[height]], [[width]]]) - 1) / 2
        pixel = math.tan(math.radians(VIEW_ANGLE / 2)) / (height / 2)
        down = np.cross(forwards, right)
        rays = forwards + pixel * (columns[..., None] * right + rows[..., None] * down)
        self.register_buffer("rays", torch.tensor(rays).float().permute(2, 0, 1))
        self.register_buffer("eye", torch.tensor(eye).float().view(3, 1, 1))
        self.convolutions = nn.Sequential(
            nn.Conv2d(6, 24, 5, 2, 2),
            nn.ReLU(),
            nn.Conv2d(24, 24, 3, 1, 1),
            nn.ReLU(),
            nn.Conv2d(24, 24, 3, 1, 2, 2),
            nn.ReLU(),
            nn.Conv2d(24, 4, 1),
            nn.PixelShuffle(2),
        )
        self.of_points = layers(10, 64, 64, 128)
        self.of_target = layers(256, 128, 64, 3)

    def see(self, state: Tensor, pixels: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
        """The target (N, 3), m, and the log-probability of each pixel that it shows the target (N, H x W)."""
        points = (self.eye + depth.permute(0, 3, 1, 2) * self.rays).clamp(-2.0, 2.0)
        from_tool, colours = points - self.tool(state)[..., None, None], pixels / 127.5 - 1.0
        bounded = from_tool / (from_tool.norm(dim=1, keepdim=True) + 0.2)
        shares = self.convolutions(torch.cat([colours, bounded], 1)).flatten(1).log_softmax(1)
        chosen, places = shares.topk(POINTS, 1)
        shown = torch.cat([points, from_tool, colours], 1).flatten(2).mT
        shown = shown.gather(1, places[..., None].expand(-1, -1, shown.shape[2]))
        parts = shown[..., :3], shown[..., 3:6], shown[..., 6:]
        return self.locate(*parts, chosen.detach()), shares

    def locate(self, points: Tensor, from_tool: Tensor, colours: Tensor, shares: Tensor) -> Tensor:
        """The target (N, 3), m, from P points in the world, their ways from the tool, their colours (N, P, 3) and their log-probabilities (N, P)."""
        weights = shares.softmax(1)[..., None]
        centre = (weights * points).sum(1)
        ways = torch.cat([points - centre[:, None], from_tool], 2) / MARKER
        sure = (shares - shares[:, :1]).clamp(min=-8.0)[..., None]
        each = self.of_points(torch.cat([ways.clamp(-5.0, 5.0), colours, sure], 2))
        together = torch.cat([each.amax(1), (weights * each).sum(1)], 1)
        target: Tensor = centre + MARKER * self.of_target(together)
        return target

    def tool(self, state: Tensor) -> Tensor:
        """The position of the tool (N, 3), m."""
        return state[:, 4 * self.joints : 4 * self.joints + 3]

    def features(self, state: Tensor, target: Tensor) -> Tensor:
        """What the policy knows, if the target (N, 3) is there, such as a step of differential inverse kinematics.

        The last action is left out: an imitator would repeat it.
        """
        way = target - self.tool(state)
        joints: Any = state[:, : self.joints]  # the kinematics take tensors, too
        jacobian: Any = self.kinematics.joint_frames(joints).jacobian[:, :3]
        damped = jacobian @ jacobian.mT + 0.01 * torch.eye(3)
        step = (jacobian.mT @ torch.linalg.solve(damped, way[..., None]))[..., 0]
        far, turn = way.norm(dim=1, keepdim=True), step.abs().amax(1, keepdim=True)
        ways = [way / (far + scale) for scale in (1.0, 0.2, 0.05, 0.02)]
        steps = [step / (turn + scale) for scale in (0.3, 0.03)]
        return torch.cat([state[:, : 4 * self.joints + 3], target, *ways, *steps], 1)

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """The features (N, F) for observations."""
        seen, _ = self.see(*(observations[name] for name in PARTS))
        return self.features(observations["state"], seen)


POLICY: dict[str, Any] = {
    "features_extractor_class": Reacher,
    "features_extractor_kwargs": {"camera": CAMERA},
    "net_arch": {"pi": [256, 256], "vf": [64]},
    "activation_fn": nn.ReLU,
    "normalize_images": False,
}


class School:
    """Arms with targets that only the teacher knows, and the student: the policy of `model`."""

    def __init__(self, arms: int) -> None:
        labelled = OPTIONS | {"pixel_channels": ["rgb", "depth", "segmentation"]}
        env = make_vector_env(ENV, arms, guide=True, autoreset_mode="SameStep", **labelled)
        env.reset(seed=0)
        self.simulation, self.teacher = env.simulation, OnnxPolicy(pretrained_file(ENV))
        self.columns = self.simulation.observation.only(OF_THE_ROBOT)[1]
        pictured: Any = self.simulation.pixels
        self.label = pictured.segments.index("target")
        self.model = PPO(
            "MultiInputPolicy",
            MaraVecEnv(make_vector_env(ENV, 1, autoreset_mode="SameStep", **OPTIONS)),
            n_steps=2,
            batch_size=2,
            policy_kwargs=POLICY,
            device="cpu",
            seed=0,
        )
        self.policy: Any = self.model.policy
        self.reacher: Any = self.policy.features_extractor
        self.kept: list[Tensor] = []
        self.count, self.room = 0, KEPT_STATES
        self.age = np.random.default_rng(0).integers(STEPS, size=arms)
        self.half = torch.arange(arms)[:, None] % 2 == 0
        self.step(torch.zeros(arms, *self.simulation.action_space.shape))

    def actions(self, state: Tensor, target: Tensor) -> Tensor:
        """The student's actions (N, A), if it sees the targets (N, 3)."""
        latent = self.policy.mlp_extractor.forward_actor(self.reacher.features(state, target))
        actions: Tensor = self.policy.action_net(latent)
        return actions

    def step(self, actions: Tensor) -> None:
        """Move the arms, begin other episodes where one is over, and note what is observed then."""
        outcome = self.simulation.step(actions.clamp(-1.0, 1.0).numpy())
        self.flat, self.age = outcome.observation, self.age + 1
        over = outcome.terminated | (self.age >= STEPS)
        if over.any():
            self.flat = np.where(over[:, None], self.simulation.reset(over)[0], self.flat)
            self.age[over] = 0
        self.state = torch.tensor(self.flat[:, self.columns]).float()
        self.target = torch.tensor(self.simulation.goal.position).float()

    def keep(self, *rows: Tensor) -> None:
        """Keep rows (N, …) to learn from, in place of the oldest."""
        if not self.count:
            self.kept = [new.new_zeros((self.room, *new.shape[1:])) for new in rows]
        places = torch.arange(self.count, self.count + len(self.age)) % self.room
        for old, new in zip(self.kept, rows, strict=True):
            old[places] = new
        self.count += len(self.age)

    def learn(self, parameters: Any, loss: Any, play: Any, batch: int, seconds: float) -> None:
        """Play and learn in turn, three times from each row, for some CPU time, with steps that shrink to zero."""
        optimiser, self.count = torch.optim.Adam(parameters), 0
        start = time.process_time()
        while (over := (time.process_time() - start) / seconds) < 1.0:
            with torch.no_grad():
                play(over)
            optimiser.param_groups[0]["lr"] = LEARNING_RATE * math.cos(math.pi / 2 * over) ** 2
            for _ in range(-(-3 * len(self.age) // batch)):
                chosen = torch.randint(min(self.count, self.room), (batch,))
                value = loss(*(rows[chosen] for rows in self.kept))
                optimiser.zero_grad()
                value.backward()
                optimiser.step()
        print(f"{loss.__name__}: {self.count} rows, loss {value.item():.4f}", flush=True)

    def play_known(self, over: float) -> None:
        """Keep what the teacher would do. It moves half of the arms, and the student the others."""
        corrected = torch.tensor(self.teacher.predict(self.flat)[0]).float().clamp(-1.0, 1.0)
        self.keep(self.state, self.target, corrected)
        self.step(torch.where(self.half, self.actions(self.state, self.target), corrected))

    def acting(self, state: Tensor, target: Tensor, action: Tensor) -> Tensor:
        """How far actions are from the teacher's. They count less within 10 mm of the target, where a network cannot learn them."""
        wrong = (self.actions(state, target) - action).abs().mean(1)
        far = (target - self.reacher.tool(state)).norm(dim=1)
        return (wrong * (100.0 * far).clamp(max=1.0)).mean()

    def play_seen(self, over: float) -> None:
        """Keep pictures. Half of the arms are led to the target, the others by the student to where it has seen the target."""
        shown = self.simulation.present(self.flat)
        pixels = torch.tensor(shown["pixels"]).permute(0, 3, 1, 2)
        depth = torch.tensor(shown["depth"])
        is_target = torch.tensor(shown["segmentation"] == self.label).flatten(1)
        seen, _ = self.reacher.see(self.state, pixels.float(), depth)
        wrong = (seen - self.target).norm(dim=1).median()
        print(f"{100 * over:.0f} %: seen {1000 * wrong:.0f} mm off", end="\r", flush=True)
        self.keep(self.state, pixels, depth.half(), is_target, self.target)
        for _ in range(SKIPPED):
            aims = torch.where(self.half, self.target, seen)
            self.step(self.actions(self.state, aims))

    def seeing(
        self, state: Tensor, pixels: Tensor, depth: Tensor, is_target: Tensor, target: Tensor
    ) -> Tensor:
        """How wrong the seen targets are, plus the cross-entropy of the pixels that show them."""
        seen, shares = self.reacher.see(state, pixels.float(), depth.float())
        count = is_target.sum(1)
        cross_entropy = -(shares * is_target).sum(1) / count.clamp(min=1)
        wrong = (seen - target).norm(dim=1).clamp(max=0.5)
        return 10.0 * wrong.mean() + 0.3 * cross_entropy[count > 0].mean()


def evaluate(model: PPO, episodes: int) -> None:
    """Print how the policy reaches targets in episodes that it has not seen, and how far off it sees them."""
    policy: Any = model.policy
    wrong: list[NDArray[np.float64]] = []

    def begin(simulation: Any) -> Any:
        def act(observation: dict[str, NDArray[Any]]) -> NDArray[np.float64]:
            with torch.no_grad():
                tensors, _ = policy.obs_to_tensor(observation)
                seen, _ = policy.features_extractor.see(*(tensors[n].float() for n in PARTS))
            wrong.append(1000.0 * np.linalg.norm(seen.numpy() - simulation.goal.position, axis=1))
            return model.predict(observation, deterministic=True)[0].astype(np.float64)

        return act

    measured = measure_acting(begin, ENV, "pinocchio", OPTIONS, episodes=episodes, seed=0)
    for name in ("success_percent", "collision_percent"):
        print(f"{METRICS[name]}: {mean_in_short(name, measured[name])}")
    rows = {"the tool": measured["position_error_mm"], "the target, seen at the start": wrong[0]}
    print("| error, mm | p50 | p95 |\n|---|---|---|")
    for name, values in {**rows, "seen at the end": wrong[-1]}.items():
        print(f"| {name} | {np.percentile(values, 50):.1f} | {np.percentile(values, 95):.1f} |")


def main() -> None:
    """Train a policy, write and evaluate it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0, help="of CPU time, to train")
    parser.add_argument("--out", type=Path, default=Path("reacher.zip"))
    parser.add_argument("--arms", type=int, default=128, help="that train side by side")
    parser.add_argument("--evaluate", type=int, default=200, help="episodes of the evaluation")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    school = School(arguments.arms)
    seconds = 60.0 * arguments.minutes
    actor = [school.policy.mlp_extractor.policy_net, school.policy.action_net]
    weights = nn.ModuleList(actor).parameters()
    school.learn(weights, school.acting, school.play_known, 256, ACTOR_SHARE * seconds)
    school.room = KEPT_PICTURES
    seer = [getattr(school.reacher, n) for n in ("convolutions", "of_points", "of_target")]
    eyes = nn.ModuleList(seer).parameters()
    school.learn(eyes, school.seeing, school.play_seen, 32, (1.0 - ACTOR_SHARE) * seconds)
    school.model.save(arguments.out)
    print(f"{arguments.out}: trained for {time.process_time() / 60.0:.1f} minutes of CPU time")
    evaluate(PPO.load(arguments.out, device="cpu"), arguments.evaluate)


if __name__ == "__main__":
    main()
