"""The entry of `optipmb-service` and of `python -m optipmb_service`."""

import sys

from optipmb_service.app import health_command


def main() -> None:
    """Run the command line; `health` without loading anything of the tracker: containers ask every few seconds."""
    if sys.argv[1:2] == ["health"]:
        sys.exit(health_command.main(sys.argv[2:]))
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
