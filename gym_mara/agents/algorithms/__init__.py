"""The algorithms: what each is called, its class, its presets and its search space; and those that are ours."""
