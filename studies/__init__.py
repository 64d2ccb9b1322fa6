"""Questions, each a folder with one command; nothing in the packages imports them, and no wheel holds them."""
