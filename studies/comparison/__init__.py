"""Recipes compared: trained over training seeds, judged on the same validation crystals, and put into one table."""
