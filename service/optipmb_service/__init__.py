"""The OptiPMB tracking service: detections and clouds come in over Zenoh, tracks go out, one session per sensor stream.

    optipmb-service --listen tcp/0.0.0.0:7447

From the outside in:

    cli, settings, logs     the command
    supervisor, child, whole, worker, share    several processes as one instance
    service, loops          the control loop: start, signals, timers, end
    health, metrics, figures, http, health    how it is, for those who ask from outside
    transport/              Zenoh, behind the protocols of ports
    registry, queries       streams and questions, found and sorted
    actor, mailbox             one stream: its queue, its worker's turn
    session, timing         one density and all decisions about it; pure
    convert, clouds, records, profiles, problems, meter

Only `transport` knows Zenoh, only `session` knows the filter.
"""

from importlib.metadata import version

__version__ = version("optipmb")

__all__ = ["__version__"]
