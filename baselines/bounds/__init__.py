"""Bounds: controllers that know the puller, the state or the future, which no sensor shows."""
