"""Plans of poses: what may be measured, what it would tell, and the way past it."""
