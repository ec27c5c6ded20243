"""``python -m dnrpipe.cli``."""

from . import main

if __name__ == "__main__":
    main()
