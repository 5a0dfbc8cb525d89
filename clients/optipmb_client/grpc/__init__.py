"""Publishing, subscribing and asking over gRPC, as over Zenoh. Needs the extra `grpc`."""

from optipmb_client.grpc.connection import GrpcConnection

__all__ = ["GrpcConnection"]
