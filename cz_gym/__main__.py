"""``python -m cz_gym``: the command ``cz-gym``."""

import sys

from cz_gym_command import main

if __name__ == "__main__":
    sys.exit(main())
