"""Loops as control engineers judge them: design, sampled loops, margins, linear forms."""
