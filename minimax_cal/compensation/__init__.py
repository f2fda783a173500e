"""What goes back to the cell: corrected targets, files for controllers and simulators."""
