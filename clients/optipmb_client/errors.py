"""What can go wrong in the client; each error's text is one line that can be shown to a person as it is.

- `ClientError`: something outside this program; the command ends with status 1.
    - `ConnectionFailed`: no router or service could be reached within the timeout, or the connection is used up.
    - `ServiceUnavailable`: the network is there, but no service answers.
    - `ServiceRefused`: a service answered, and said no.
- `UsageError`: a wrong option or path; the command ends with status 2.
"""

__all__ = ["ClientError", "ConnectionFailed", "ServiceRefused", "ServiceUnavailable", "UsageError"]


class ClientError(Exception):
    """Something outside this program kept it from doing its work."""


class ConnectionFailed(ClientError):  # noqa: N818  the name says what happened, as ConnectionRefusedError's siblings do
    """No Zenoh router could be reached, the endpoint or configuration file is none, or the connection is used up.

    A connection is used up when it is closed, or has declared all the keys that it can in its life.

    Attributes:
        endpoints: Endpoints that were tried.
        timeout: How long, in seconds.
    """

    def __init__(self, message: str, *, endpoints: tuple[str, ...] = (), timeout: float = 0.0) -> None:
        super().__init__(message)
        self.endpoints = endpoints
        self.timeout = timeout


class ServiceUnavailable(ClientError):  # noqa: N818  as above
    """The network is there, but no tracking service answered within the time given."""


class ServiceRefused(ClientError):  # noqa: N818  as above
    """A tracking service answered a query with an error."""


class UsageError(Exception):
    """The caller asked for something that does not exist: a data set, a directory, a class."""


class TrackingFailed(ClientError):  # noqa: N818  as above
    """A frame raised in the tracker; the text says which and what."""
