"""What no sensor could feed: controllers that are told the puller, the state or the future."""
