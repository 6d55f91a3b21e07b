"""The pages' tables, as `make lint` checks them; see `taxeld_training.trials.tables`."""

import sys

from taxeld_training.trials.tables import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
