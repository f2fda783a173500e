"""Which columns explain what a fit leaves: candidates, alternatives, noise."""
