"""`optipmb warm-up`: compile the tracker ahead of its first frame."""

import time

from optipmb_client.commands.options import AsJson, print_json, say


def warm_up(*, as_json: AsJson = False) -> None:
    """Compile the tracker into its cache, as the last step of an installation or of an image."""
    from optipmb_client import offline  # noqa: PLC0415  the help does not load the tracker

    begun = time.monotonic()
    compiled = offline.warm_up()
    seconds = round(time.monotonic() - begun, 1)
    if as_json:
        print_json({"command": "warm-up", "compiled": compiled, "seconds": seconds})
        return
    say(f"compiled {compiled} kernels in {seconds} s" if compiled else f"all kernels were compiled ({seconds} s)")
