"""Looks at a policy: trajectories, the viewer, films, a comparison of backends, and reports."""
