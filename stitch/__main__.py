"""Run the command line as `python -m stitch`."""

from stitch.cli.main import main

if __name__ == "__main__":
    main()
