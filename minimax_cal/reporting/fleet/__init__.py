"""Many cells in one go: what is to be done, each done on its own, one overview of all."""
