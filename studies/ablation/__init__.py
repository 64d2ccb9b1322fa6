"""What helps: one change of a recipe at a time, ``python -m studies.ablation``."""
