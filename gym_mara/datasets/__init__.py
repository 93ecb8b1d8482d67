"""Data sets: episodes of a policy, of inverse kinematics or of a hand, as the libraries of imitation learning read them."""
