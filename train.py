"""Train an agent on Cz-v0: ``python train.py --help``. It is ``cz-gym train`` in a clone."""

import sys

from cz_gym_command import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
