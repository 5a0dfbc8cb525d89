"""Coverage-guided search for bytes that the message decoder neither reads nor refuses.

Run it as `python fuzz_messages.py CORPUS`. The first byte chooses the message type. What is read is written and read
again: it must be equal.
"""

import sys

import atheris

with atheris.instrument_imports(include=["optipmb_schemas"]):
    import optipmb_schemas as schemas

LIMITS = schemas.Limits(max_bytes=2**16, max_json_bytes=2**16, max_values=2**12)


def one_input(data: bytes) -> None:
    """Read one payload."""
    if not data:
        return
    kind = schemas.MESSAGES[data[0] % len(schemas.MESSAGES)]
    try:
        message = schemas.decode(data[1:], kind, limits=LIMITS)
    except schemas.MessageError:
        return
    assert schemas.decode(schemas.encode(message), kind) == message


if __name__ == "__main__":
    atheris.Setup(sys.argv, one_input)
    atheris.Fuzz()
