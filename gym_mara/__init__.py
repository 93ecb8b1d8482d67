"""gym_mara: Gymnasium environments for the modular robot arm MARA and other arms. Importing it registers them."""

from importlib.util import find_spec

__version__ = "0.2.0"
__all__ = ["register_task"]

# On a robot's computer, `gym_mara.deploy` works without Gymnasium.
if find_spec("gymnasium") is not None:
    from gym_mara.registration import register_environments, register_task

    register_environments()
