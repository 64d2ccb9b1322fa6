"""Controllers of a whole crystal, whose gains and compensation run with its length."""
