"""The entry of `optipmb-service` and of `python -m optipmb_service`."""

import os
import signal
import sys

from optipmb_service.app import ENDING


def main() -> None:
    """Run the command line; `health` without loading anything of the tracker: containers ask every few seconds."""
    if sys.argv[1:2] == ["health"]:
        from optipmb_service.app import health_command  # noqa: PLC0415 - nothing else needs it so early

        sys.exit(health_command.main(sys.argv[2:]))
    # Before all imports, which take a second: process 1 of a container gets no signal that it does not handle.
    for number in ENDING:
        if signal.getsignal(number) != signal.SIG_IGN:  # as under `nohup`
            signal.signal(number, lambda *_: os._exit(0))  # nothing has begun
    try:
        from optipmb_service.app import cli  # noqa: PLC0415 - a second that `health` can do without
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("optipmb"):
            raise
        from optipmb_schemas.installation import install_command  # noqa: PLC0415 - as above

        sys.exit(f"optipmb-service needs {error.name}, which is not installed: {install_command('service')}")
    cli.main()


if __name__ == "__main__":
    main()
