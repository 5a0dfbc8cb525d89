"""The OptiPMB tracking service: detections and clouds come in over Zenoh, tracks go out, one session per sensor stream.

    optipmb-service --listen tcp/0.0.0.0:7447

From the outside in:

    app             the command, processes, the parts of a service put together, start and end
    http, grpc, ros2    edges: health, metrics, page; gateway; bridge
    stream          sessions, which know the filter, and around them backlogs, tracking, recovery, checkpoints, queries
    zenoh           the network
    cluster         leases, checkpoints and the log: SQLite or NATS
    telemetry       metrics, health, problems, logs
"""

from importlib.metadata import version

__version__ = version("optipmb")

__all__ = ["__version__"]
