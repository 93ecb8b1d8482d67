"""Plays many episodes and measures them: those of a policy, or those of a baseline."""
