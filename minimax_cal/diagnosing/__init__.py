"""What is still wrong, and why."""
