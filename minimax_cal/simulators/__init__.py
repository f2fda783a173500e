"""The arm in a physics simulator: MJCF files, and how far a simulated arm is from the real one."""
