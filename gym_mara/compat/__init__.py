"""Interfaces of other packages to these environments."""
