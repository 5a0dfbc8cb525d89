"""What makes the end of a process hang: Python runs it at the start of a process that has this folder on its path.

`HANG` says where: `close`, in closing the Zenoh session; `lock`, there too, with the interpreter's lock held;
`leave`, in the first step of a member's end; `loop`, in its control loop, before the end. The end has less time for a
handover, by `HANDOVER_S`. Workers inherit the variables from their parent.
"""

import ctypes
import os
import sys
import time

from optipmb_client.zenoh import session
from optipmb_service.app import lifecycle, service
from optipmb_service.zenoh import transport

LONG_S = 3600


def hang(*_: object) -> None:
    """Wait, as a library does that has met a bug."""
    time.sleep(LONG_S)


def hang_in_the_loop(*_: object) -> None:
    """Say so, and wait."""
    print("the loop hangs", file=sys.stderr, flush=True)  # noqa: T201 - the test waits for it
    hang()


def hang_with_the_lock(*_: object) -> None:
    """Wait in machine code that lets no other Python run."""
    ctypes.PyDLL(None).sleep(LONG_S)


for module in (lifecycle, service):
    module.HANDOVER_S = float(os.environ["HANDOVER_S"])  # type: ignore[misc]  # shorter than in production

if os.environ["HANG"] == "leave":
    transport.Transport.leave = hang  # type: ignore[method-assign]  # it is to hang
elif os.environ["HANG"] == "loop":
    service.Service.housekeeping = hang_in_the_loop  # type: ignore[method-assign]  # the loop is to hang
else:
    session.close_session = hang if os.environ["HANG"] == "close" else hang_with_the_lock
