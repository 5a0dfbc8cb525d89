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

__all__ = ["__version__"]


def __getattr__(name: str) -> str:
    """Return the version when it is asked for: reading it takes half of the time before signals have handlers."""
    if name != "__version__":
        raise AttributeError(f"module {__name__} has no attribute {name}")
    from importlib.metadata import version  # noqa: PLC0415 - for the same reason

    return version("optipmb")
