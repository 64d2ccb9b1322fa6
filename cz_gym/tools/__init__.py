"""Commands that bring plant, controllers and agents together; nothing else in the package imports them."""
