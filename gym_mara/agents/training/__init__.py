"""Training: it starts, resumes, checkpoints and plots a run."""

LOGGERS = ("csv", "tensorboard", "wandb")
"""Where a training can log its values, by name."""
DEFAULT_LOGGERS = ("csv", "tensorboard")
