"""Plain tools learn on Cz-v0: ``python -m studies.plain_tools`` runs the examples' PPO over training seeds."""
