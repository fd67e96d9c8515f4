"""Run the command line as `python -m stitch`."""

from stitch.cli.main import main

main()
