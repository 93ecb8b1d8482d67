"""Many runs: grids, searches for hyperparameters, figures, and the executors that run them in parallel."""
