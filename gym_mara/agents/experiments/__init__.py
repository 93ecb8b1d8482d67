"""Many runs: grids of trainings, searches for hyperparameters, figures, and what runs them in parallel."""
