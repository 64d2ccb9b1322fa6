"""What only serves the others: files, names, command lines, processors, plausible numbers, units."""
