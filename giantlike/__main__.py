"""``python -m giantlike``: the command line."""

from giantlike.cli import main

if __name__ == "__main__":
    main()
