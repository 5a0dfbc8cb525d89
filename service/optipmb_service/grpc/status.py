"""How a call that cannot go on ends: one status code, one line, and details that name the field at fault."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import grpc
from google.protobuf import any_pb2
from google.rpc import error_details_pb2, status_pb2
from grpc_status import rpc_status

if TYPE_CHECKING:
    import optipmb_schemas as schemas

CODES: Final[dict[str, grpc.StatusCode]] = {"too_large": grpc.StatusCode.RESOURCE_EXHAUSTED}
"""Codes of messages that are refused for another reason than that they are not valid."""


class EndCall(Exception):  # noqa: N818 - it ends a call, and need not be an error
    """Ends the call with a status.

    Attributes:
        code: of the status.
        message: one line.
        error: the field at fault, if there is one.
    """

    def __init__(self, code: grpc.StatusCode, message: str, error: schemas.MessageError | None = None) -> None:
        super().__init__(message)
        self.code = code
        self.message = message
        self.error = error

    def status(self) -> grpc.Status:
        """Return the status with its details."""
        status = status_pb2.Status(code=self.code.value[0], message=self.message)
        if self.error is not None:
            violation = error_details_pb2.BadRequest.FieldViolation(
                field=self.error.path,
                description=f"expected {self.error.expected}, received {self.error.received}",
                reason=self.error.code.upper(),
            )
            packed = any_pb2.Any()
            packed.Pack(error_details_pb2.BadRequest(field_violations=[violation]))
            status.details.append(packed)
        return rpc_status.to_status(status)


def refused(error: schemas.MessageError) -> EndCall:
    """Return the end of a call whose request is not valid."""
    code = CODES.get(error.code, grpc.StatusCode.INVALID_ARGUMENT)
    return EndCall(code, str(error), error.with_traceback(None))  # its frames hold the request
