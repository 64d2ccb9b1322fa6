"""What studies of learners share: runs that are kept, and the LQG's settings on the same crystals."""
