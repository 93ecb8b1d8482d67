"""Mesh files: where they are, what is checked in them, and the one reader."""
