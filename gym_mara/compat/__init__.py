"""Forms that other packages gave these environments."""
