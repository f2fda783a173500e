"""What an arm in motion shows of its drives and masses, in a simulator's model."""
