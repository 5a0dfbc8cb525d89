"""The same messages in protobuf, for gRPC: `schemas/proto/optipmb/v1/tracking.proto`. Needs the extra `grpc`.

    from optipmb_schemas.protobuf import tracking_pb2, tracking_pb2_grpc

`convert` takes one form to the other. The models check the values of both forms.
"""
