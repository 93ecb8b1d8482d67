"""gym_mara: Gymnasium environments for the modular robot arm MARA and other arms. Importing it registers them."""

from gym_mara.registration import register_environments, register_task

__version__ = "0.1.0"
__all__ = ["register_task"]

register_environments()
