"""Pictures of results, one a module."""
