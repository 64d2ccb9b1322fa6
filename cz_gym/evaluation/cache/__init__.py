"""Episodes that were run before: of slow controllers, and of the bound."""
