"""Pictures of a growing crystal: everything here reads an episode and never changes it."""
