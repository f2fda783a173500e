"""Robots: their files, kinematics, gravity, URDF."""
