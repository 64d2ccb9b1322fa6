"""The process of ``Cz-v0``: the body of a crystal, its plant, signals, task, cost and schedule."""
