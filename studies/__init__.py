"""Questions, each answered by one command; nothing in the packages imports them, and no wheel holds them."""

import sys

try:
    import cz_gym  # noqa: F401  (says in a line what is missing, before a study imports more)
except KeyboardInterrupt:
    print("interrupted", file=sys.stderr)
    sys.exit(130)
