"""Solvers that know no robot: separable least squares and minimax SQP."""
