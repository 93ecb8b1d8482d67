"""Makes the View of an arm that renderers and the viewer draw."""

from __future__ import annotations

from gym_mara.arrays import host
from gym_mara.envs.simulation import Simulation
from gym_mara.rendering.view import View


def first_view(simulation: Simulation) -> View:
    """The View of the arm in its home pose, with the target before the first episode: the same in all environments alike."""
    goal = simulation.episodes.first_goal
    return View(simulation.robot.home, goal.position[0], goal.quaternion[0])


def view_of(simulation: Simulation, arm: int) -> View:
    """The View of an arm in the state of its last observation: after a collision, it shows the colliding state."""
    state, goal = simulation.observed(arm), simulation.goal
    q = host(state.q[arm])
    touching: frozenset[str] = frozenset()
    if state.collided[arm]:
        if state.contacts is not None:
            touching = frozenset(link for contact in state.contacts[arm] for link in contact.links)
        if not touching:
            from gym_mara.collision.coal import touching_links

            touching = touching_links(simulation.robot, q)
    return View(q, host(goal.position[arm]), host(goal.quaternion[arm]), touching)
