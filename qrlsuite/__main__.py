"""`python -m qrlsuite`."""

from qrlsuite.cli import main

if __name__ == "__main__":
    main()
