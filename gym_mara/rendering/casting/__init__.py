"""Ray casting on the CPU with Embree: pictures of many arms at once."""
