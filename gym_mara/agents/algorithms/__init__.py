"""The registry of algorithms, with their presets and search spaces; and the algorithms of this package."""
