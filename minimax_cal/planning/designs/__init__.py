"""Designs of experiments: which of many to do, whatever they measure."""
