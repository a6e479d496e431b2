"""``python -m icrtool``."""

from icrtool.cli import main

if __name__ == "__main__":
    main()
