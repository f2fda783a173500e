"""An arm in its place as a model: parameters, errors, effects beyond geometry, simulation."""
