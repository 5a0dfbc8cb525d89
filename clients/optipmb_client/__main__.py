"""`python -m optipmb_client` is the command `optipmb`."""

from optipmb_client.cli import main

if __name__ == "__main__":
    main()
