"""What a policy does: recorded, watched, filmed, compared across backends, reported."""
