"""Coverage-guided search for bytes that the checkpoint decoder neither reads nor refuses.

Run it as `python fuzz_checkpoints.py CORPUS`.

The bytes are sealed first, so that the search gets behind the digest. What is read is taken up by a session.
"""

import contextlib
import sys

import atheris

import optipmb  # noqa: F401 - first, and not instrumented: its kernels are compiled

with atheris.instrument_imports(include=["optipmb_schemas", "optipmb_service"]):
    from optipmb_service.session.checkpoint import CheckpointError, decode_checkpoint, encode_checkpoint, seal
    from optipmb_service.session.session import Session


class Idle:
    """A tracker that is never asked."""

    def __init__(self, parameters: object) -> None:
        self.parameters = parameters


def one_input(data: bytes) -> None:
    """Read one body."""
    with contextlib.suppress(CheckpointError):
        decode_checkpoint(data)
    try:
        checkpoint = decode_checkpoint(seal(data))
        session = Session.restore(checkpoint, 0, tracker=Idle)  # type: ignore[arg-type]  # it steps nothing
    except CheckpointError:
        return
    session.state()
    assert decode_checkpoint(encode_checkpoint(checkpoint)).stream == checkpoint.stream


if __name__ == "__main__":
    atheris.Setup(sys.argv, one_input)
    atheris.Fuzz()
