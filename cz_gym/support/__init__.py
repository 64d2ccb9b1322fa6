"""Helpers of the other rooms: files, names, command lines, errors, units."""
