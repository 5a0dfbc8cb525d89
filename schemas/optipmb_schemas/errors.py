"""The one error of the package: the fault, its place, the expected and the received value.

A path names a field and an element of it, as `score[3]`, `center[7][1]` or `sessions[2].stream`; the empty path is the
message as a whole. Texts that quote a received value are always short and printable, so that they can go
into logs, terminals and `Problem` messages as they are.
"""

from typing import Any, Final, Literal

Code = Literal["malformed", "wrong_type", "unsupported_version", "too_large", "missing_field", "invalid_value"]

CODES: Final[dict[Code, str]] = {
    "malformed": "The bytes are not one msgpack or JSON map: cut short, trailing bytes, duplicate keys, bad UTF-8.",
    "wrong_type": "The encoding names another message type, or none of ours.",
    "unsupported_version": "The encoding names a major version that the receiver does not know.",
    "too_large": "A size, a count, a text or the nesting is above the limit of the receiver.",
    "missing_field": "A required field is absent.",
    "invalid_value": "A field has the wrong type, shape or value. The path names the element.",
}
"""What each code means, for people."""

SHOWN: Final = 80
"""Most characters of a received value that an error quotes."""

_WORD: Final = 64


class MessageError(ValueError):
    """A message or a name is not valid. Constructors, decoders and key functions of this package raise nothing else.

    Attributes:
        code: one of `CODES`, for programs.
        path: the field and element, empty for the message as a whole.
        expected: what the description of the message asks for.
        received: the value found there, as a short printable text.
    """

    def __init__(self, code: Code, path: str, expected: str, received: str) -> None:
        super().__init__(code, path, expected, received)  # as args: errors cross process borders pickled
        self.code: Code = code
        self.path = path
        self.expected = expected
        self.received = received

    def __str__(self) -> str:
        return f"{self.path or 'message'}: expected {self.expected}, received {self.received} [{self.code}]"

    def under(self, path: str) -> "MessageError":
        """Return the same error seen from the field `path` that holds the value."""
        separator = "." if self.path and not self.path.startswith("[") else ""
        return MessageError(self.code, f"{path}{separator}{self.path}", self.expected, self.received)


def invalid(path: str, expected: str, received: object) -> MessageError:
    """Return an `invalid_value` error that quotes `received`."""
    return MessageError("invalid_value", path, expected, show(received))


def show(value: object) -> str:
    """Return a short printable ASCII text for any received value, in time and memory that do not grow with it."""
    shape: Any = getattr(value, "shape", None)  # arrays and scalars of numpy, and of libraries like it
    if shape == () and hasattr(value, "item"):
        value = value.item()
    if value is None:
        text = "nothing"
    elif isinstance(value, str):
        text = ascii(value[:SHOWN])
    elif isinstance(value, int) and value.bit_length() > _WORD:  # writing out a long integer takes quadratic time
        text = f"an integer of {value.bit_length()} bits"
    elif isinstance(value, int | float):
        text = repr(value)
    elif type(shape) is tuple and hasattr(value, "dtype"):
        text = f"{value.dtype} array of shape {shape_text(shape)}"
    else:
        text = _show_container(value)
    return cut(text)


def _show_container(value: object) -> str:
    if isinstance(value, bytes | bytearray | memoryview):
        return f"{len(value)} bytes"
    if isinstance(value, list | tuple):
        return f"a list of {len(value)}"
    if isinstance(value, dict):
        return f"a map of {len(value)}"
    return f"a value of type {type(value).__name__}"


def cut(text: str) -> str:
    """Return `text`, its end replaced by dots when it is longer than errors quote."""
    return text if len(text) <= SHOWN else text[: SHOWN - 3] + "..."


def shape_text(shape: tuple[object, ...]) -> str:
    """Return a shape as the descriptions write it: `(M, 3)`, `(5,)`."""
    return f"({shape[0]},)" if len(shape) == 1 else f"({', '.join(str(n) for n in shape)})"


def path_of(location: tuple[int | str, ...]) -> str:
    """Return the path of a location given as keys and indices: `("sessions", 2, "stream")` is `sessions[2].stream`."""
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location)
    return cut(text.removeprefix("."))
