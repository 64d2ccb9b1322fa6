"""Training with stable-baselines3: recipes, networks, learners, runs with checkpoints."""
