"""Controllers and agents on the same crystals, in one table: ``python benchmark.py --help``, ``cz-gym benchmark``."""

import sys

from cz_gym_command import main

if __name__ == "__main__":
    sys.exit(main(["benchmark", *sys.argv[1:]]))
