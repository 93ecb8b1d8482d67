"""Bags: recorded, replayed, and turned into logs and episodes."""
