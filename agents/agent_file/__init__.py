"""An agent as a file: its contract, what its graph may hold, and how it is written."""
