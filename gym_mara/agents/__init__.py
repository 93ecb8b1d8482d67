"""Training and evaluating agents; everything here needs the extra `train`."""
