"""What a robot is read from: URDF, SRDF, mesh files and MARA's modules."""
