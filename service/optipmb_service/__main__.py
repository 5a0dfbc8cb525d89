"""The entry of `optipmb-service` and of `python -m optipmb_service`."""

import sys

from optipmb_service.app import health_command


def main() -> None:
    """Run the command line; `health` without loading anything of the tracker: containers ask every few seconds."""
    if sys.argv[1:2] == ["health"]:
        sys.exit(health_command.main(sys.argv[2:]))
    from optipmb_service.app import cli  # noqa: PLC0415 - a second that `health` can do without

    cli.main()


if __name__ == "__main__":
    main()
