"""The compiled batch: one loop that steps one slot or ten thousand."""
