"""The command `optipmb`, which is also `python -m optipmb_tools`."""

import gc
import sys
from typing import NoReturn

from optipmb_tools.extras import to_install


def main() -> NoReturn:
    """Run the command line of this process and exit; a missing package gives the command that installs it."""
    gc.disable()  # imported objects stay: collecting them again and again would be a tenth of the start
    try:
        from optipmb_tools import cli  # noqa: PLC0415 - packages of an extra
    except ModuleNotFoundError as error:
        text = to_install(error.name or "", "the command optipmb")
        if text is None:
            raise
        sys.exit(f"optipmb: {text}")
    gc.enable()
    cli.main()


if __name__ == "__main__":
    main()
