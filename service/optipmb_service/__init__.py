"""The OptiPMB tracking service: detections and clouds come in over Zenoh, tracks go out, one session per sensor stream.

    optipmb-service --listen tcp/0.0.0.0:7447

From the outside in:

    app             the command, processes, the parts of a service put together, start and end
    http, grpc, ros2    edges: health, metrics, page; gateway; bridge
    zenoh           the network, behind the protocols of `runtime.ports`
    cluster         leases, checkpoints and the log: SQLite or NATS
    runtime         streams and queries, found and sorted; one actor for each stream
    session         one density and all decisions about it
    telemetry       metrics, health, problems, logs

Only `zenoh` knows Zenoh, only `session` knows the filter.
"""

from importlib.metadata import version

__version__ = version("optipmb")

__all__ = ["__version__"]
