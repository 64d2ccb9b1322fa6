"""What only serves the others: files, names, command lines, interrupts, processors, plausible numbers, units."""
