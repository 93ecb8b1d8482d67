"""A run on disk: its folder, its policy, and how good it is."""
