"""Hostile runs of every command, each judged: `python -m tests.fuzz --cases N --seed S`."""
