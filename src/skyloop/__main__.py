"""``python -m skyloop`` is the ``skyloop`` command."""

from skyloop.cli import main

if __name__ == "__main__":
    main()
