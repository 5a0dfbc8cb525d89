"""``python -m optipmb_service`` is ``optipmb-service``."""

from optipmb_service.cli import main

if __name__ == "__main__":
    main()
