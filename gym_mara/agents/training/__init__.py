"""Training: it starts, resumes, checkpoints and plots a run."""
