"""The command line; before its packages are there, what has to be installed."""

import sys

from stitch.errors import InputError
from stitch.system.packages import missing_package, small_requirements

_SMALL = ["doctor", "--requirements", "small"]


def main() -> None:
    """Run the command line; if one of its packages is not installed, print how to install them, and exit with 2.

    `stitch doctor --requirements small` is answered here, since it has to work without these packages.
    """
    if sys.argv[1:] == _SMALL:
        print("\n".join(small_requirements()))
        return
    try:
        from stitch.cli.main import main as run
    except ModuleNotFoundError as error:
        line = missing_package(error)
        if line is None:
            raise
        asked = " ".join(f"'{requirement}'" for requirement in small_requirements())
        print(f"stitch: {line.partition(';')[0]}; to fix: pip install {asked}", file=sys.stderr)
        sys.exit(InputError.exit_code)
    run()


if __name__ == "__main__":
    main()
