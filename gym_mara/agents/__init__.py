"""Training and evaluation of agents. All of it but the registry of algorithms needs the extra `train`."""
