"""The option --policy: a policy of a run, an exported one, or the pretrained one of an environment."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gym_mara.cli.common import one_of
from gym_mara.errors import GymMaraError, unknown
from gym_mara.pretrained import pretrained_file

RUN_POLICIES = ("last", "best")
PRETRAINED = "pretrained"
ONNX = ".onnx"
"""The ending of exported policies."""
_OF_RUN = "last, or best: the policy with the highest reward in the evaluations of the training"


def _any_policy(text: str) -> str:
    valid = (*RUN_POLICIES, PRETRAINED)
    if text in valid or text.endswith(ONNX):
        return text
    raise typer.BadParameter(
        f"{unknown('policy', text, valid)} Or name a file that ends in {ONNX}."
    )


PolicyOption = Annotated[
    str,
    typer.Option(parser=one_of("policy", lambda: RUN_POLICIES), metavar="NAME", help=f"{_OF_RUN}."),
]
AnyPolicyOption = Annotated[
    str,
    typer.Option(
        parser=_any_policy,
        metavar="NAME",
        help=f"Of a run: {_OF_RUN}. Without a run: {PRETRAINED}, the policy of gym_mara for --env, or a file of gym-mara export.",
    ),
]


def exported_file(run: Path | None, policy: str, env: str) -> Path | None:
    """The file of the exported policy that `--policy` names; None for a policy of a run.

    Raises:
        GymMaraError: a run is given as well, or the environment has no pretrained policy.
    """
    if policy in RUN_POLICIES:
        return None
    if run is not None:
        raise GymMaraError(
            f"a run has its own policies, {' and '.join(RUN_POLICIES)}: leave out the run folder, or --policy {policy}"
        )
    return pretrained_file(env) if policy == PRETRAINED else Path(policy)
