"""Which settings the service has.

Times are in seconds. Every setting is described where it stands; `docs/reference.md` prints the same table, and so does
``optipmb-service config``.
"""

from __future__ import annotations

import ipaddress
import os
import re
import secrets
import socket
from pathlib import Path
from typing import Final, Literal

from pydantic import Field
from pydantic_settings import BaseSettings, PydanticBaseSettingsSource, SettingsConfigDict

from optipmb_service.settings.forms import (
    DEFAULT_LISTEN,
    Address,
    Endpoints,
    Names,
    Patterns,
    Prefix,
    Servers,
)
from optipmb_service.settings.tables import LimitSettings, Ros2Settings

PREFIX: Final = "OPTIPMB_"
"""Of environment variables."""


RUN: Final = secrets.token_hex(3)
"""Tells this process from one with its number in another container that has the host's name."""

HOST_CHARACTERS: Final = 40


def _default_instance() -> str:
    """Return a name that two services do not share."""
    host = re.sub(r"[^A-Za-z0-9_.-]", "-", socket.gethostname()[:HOST_CHARACTERS]) or "host"
    return f"{host}-{os.getpid()}-{RUN}"


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def state_home() -> Path:
    """Return the folder below which state is kept that no setting gives a place."""
    state = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(state or Path(home) / "optipmb")


class Settings(BaseSettings):
    """What the service runs with."""

    model_config = SettingsConfigDict(
        frozen=True, extra="forbid", env_prefix=PREFIX, env_nested_delimiter="__", allow_inf_nan=False
    )

    instance: str = Field(
        default_factory=_default_instance,
        pattern=r"^[A-Za-z0-9_.-]{1,64}$",
        description="name of this instance; default: the host's name, the process number and six random digits",
    )
    prefix: Prefix = Field(default="optipmb/v1", description="first chunks of every key")
    router: bool | None = Field(
        default=None,
        description="run a Zenoh router in this process; default: yes unless `connect` is given",
    )
    listen: Endpoints | None = Field(
        default=None, description=f"endpoints to listen on; default: `{DEFAULT_LISTEN}` as a router, none as a client"
    )
    connect: Endpoints = Field(default=(), description="endpoints of routers to connect to; retried without end")
    zenoh_config: Path | None = Field(
        default=None,
        description="Zenoh configuration file (JSON5): TLS, access control, limits of a router; settings override it",
    )
    shared_memory: bool = Field(
        default=False,
        description="Zenoh's shared memory: faster for clouds on one host, but may lose messages, and leaves files in"
        " /dev/shm after a kill",
    )
    profile: str = Field(
        default="generic", min_length=1, description="profile name or TOML file, where no pattern matches"
    )
    profiles: dict[str, str] = Field(
        default_factory=dict,
        description="profiles by stream pattern (as `site/*/lidar*`); the first match applies",
    )
    fuse: Patterns = Field(
        default=(),
        description="patterns of streams (as `site/*/lidar*`) that feed one session per node, `site/node/fused`",
    )
    cloud_wait_s: float = Field(default=0.1, ge=0, le=60, description="longest wait of a frame for its cloud")
    cloud_memory_s: float = Field(
        default=2.0,
        ge=0,
        le=3600,
        description="frames without `has_points` wait for a cloud if one came within this time, in stamps",
    )
    gap_limit_s: float = Field(
        default=5.0,
        gt=0,
        le=86400,
        description="a larger step of the stamps, forward or back, on which three frames agree, restarts the session",
    )
    rewind_s: float = Field(
        default=1.0,
        ge=0,
        le=60,
        description="sensor time within which a late frame is inserted and tracks are corrected; 0: never",
    )
    late_clouds: bool = Field(
        default=False, description="a cloud that comes after its frame was tracked corrects the tracks"
    )
    recovery_wait_s: float = Field(
        default=2.0,
        ge=0,
        le=60,
        description="longest wait for the publisher's cache after a restart",
    )
    max_speed: float = Field(
        default=100.0,
        ge=0,
        le=1e6,
        description="highest speed of a sensor, m/s; poses beyond it are refused; 0: no check",
    )
    queue_frames: int = Field(
        default=1024,
        ge=1,
        le=65536,
        description="frames waiting per stream, as many as a publisher's cache may send at once after an outage; then"
        " the oldest is dropped",
    )
    queue_clouds: int = Field(
        default=16,
        ge=1,
        le=1024,
        description="clouds waiting per stream, and as many in its session; then the oldest is dropped",
    )
    workers: int = Field(default=1, ge=1, le=64, description="processes that share the streams; 1: this process alone")
    max_pairs: int = Field(
        default=20_000,
        ge=100,
        le=10_000_000,
        description="pairs of nearby objects in a frame, a microsecond each; a frame with more is refused",
    )
    step_limit_s: float = Field(
        default=0.5,
        gt=0,
        le=60,
        description="processor time of a message; a stream that takes more is refused for nine times as long",
    )
    stream_mb: int = Field(
        default=128,
        ge=4,
        le=65536,
        description="megabytes per stream, a quarter each for waiting messages, clouds, held frames and the window;"
        " then the oldest are dropped",
    )
    memory_mb: int = Field(
        default=1024,
        ge=16,
        le=1_048_576,
        description="megabytes of messages per process, half of them waiting; then messages are dropped, and the least"
        " recently used sessions closed",
    )
    max_sessions: int = Field(
        default=1000, ge=1, le=10_000, description="streams tracked at once; further ones are refused"
    )
    node_sessions: int = Field(
        default=64, ge=0, le=100_000, description="the same of one node (`site/node`); 0: no limit"
    )
    node_rate: int = Field(default=2000, ge=0, le=1_000_000, description="messages a second of one node; 0: no limit")
    node_mb_s: int = Field(default=500, ge=0, le=100_000, description="megabytes a second of one node; 0: no limit")
    site_sessions: int = Field(default=0, ge=0, le=100_000, description="the same of one site; 0: no limit")
    site_rate: int = Field(default=0, ge=0, le=1_000_000, description="messages a second of one site; 0: no limit")
    site_mb_s: int = Field(default=0, ge=0, le=100_000, description="megabytes a second of one site; 0: no limit")
    keep_days: float = Field(
        default=30.0,
        ge=0,
        le=36_500,
        description="checkpoints of a stream silent for this long are deleted; 0: never",
    )
    idle_s: float = Field(default=600.0, gt=0, description="a session without messages for this long is freed")
    cluster: Servers = Field(
        default=(),
        description="NATS servers, as `nats://10.0.0.1:4222`, by which instances on many machines share streams",
    )
    cluster_tls: Path | None = Field(
        default=None,
        description="folder with `ca.pem`, the authority of `tls://` servers, and `cert.pem` and `key.pem` where they"
        " ask for a certificate; default: the system's authorities",
    )
    cluster_credentials: Path | None = Field(
        default=None,
        description="file with the credentials of a NATS user (`.creds`), `user:password`, or a token",
    )
    store: str = Field(
        default="",
        description="folder of checkpoints and quarantined sessions; `none`: nothing is kept; default: one named after"
        " prefix and endpoint in `$STATE_DIRECTORY`, else in `optipmb` under `$XDG_STATE_HOME` or `~/.local/state`",
    )
    checkpoint_s: float = Field(
        default=1.0, ge=0.05, le=3600, description="time between checkpoints of a changed session"
    )
    lease_s: float = Field(
        default=3.0,
        ge=0.5,
        le=60,
        description="a process that is frozen or cut off for this long loses its streams to the others",
    )
    standby_s: float = Field(
        default=10.0,
        ge=0,
        le=600,
        description="how long messages of streams that others track are kept for a takeover; longer than `lease_s` and"
        " `checkpoint_s` together; with `cluster` also how far back the log is read without a checkpoint",
    )
    standby_mb: int = Field(
        default=256,
        ge=1,
        le=65536,
        description="megabytes kept so; clouds are dropped first",
    )
    log_s: float = Field(
        default=600.0,
        ge=10,
        le=864_000,
        description="age up to which `optipmb-service log` keeps detections, for a successor",
    )
    log_mb: int = Field(default=1024, ge=16, le=1_048_576, description="megabytes of these; the oldest go first")
    log_tracks_s: float = Field(
        default=3600.0,
        ge=0,
        le=8_640_000,
        description="age up to which it keeps tracks, for `q/tracks`; 0: none",
    )
    log_tracks_mb: int = Field(default=1024, ge=16, le=1_048_576, description="megabytes of these; the oldest go first")
    stale_s: float = Field(default=2.0, gt=0, description="a stream without frames for this long is logged as stale")
    stuck_s: float = Field(
        default=5.0,
        ge=1,
        le=600,
        description="a thread busy with one task, or a worker silent, for this long is stuck: the process is not"
        " healthy, the worker is replaced",
    )
    restart_keys: int = Field(
        default=50_000,
        ge=100,
        le=60_000,
        description="keys declared on the network after which a process restarts, its sessions continue from the store:"
        " Zenoh has 65,535 for the life of a process, and each stream that opens takes up to 5",
    )
    grace_s: float = Field(default=1.0, ge=0, le=60, description="at shutdown, time for frames already received")
    http: Address = Field(
        default="",
        description="address of health, metrics and live page, as `127.0.0.1:8080`",
    )
    http_hosts: Names = Field(
        default=(),
        description="host names with a dot by which the page may be asked for, besides addresses and names without;"
        " `*`: any",
    )
    http_streams: int = Field(
        default=100, ge=0, le=10_000, description="streams with series of their own in the metrics, by name"
    )
    grpc: Address = Field(default="", description="address of the gRPC server, as `127.0.0.1:50051`")
    grpc_tls: Path | None = Field(
        default=None,
        description="folder with `key.pem`, `cert.pem` and `ca.pem` for gRPC: callers need a certificate of that"
        " authority, by whose name they have rights; default: no TLS, all may do everything",
    )
    grpc_names: Path | None = Field(
        default=None, description="JSON list of the names that may call; default: all with a certificate or token"
    )
    grpc_tokens: str = Field(
        default="",
        pattern=r"^([A-Za-z_][\w.]*:[A-Za-z_]\w*)?$",
        description="`module:function` that finds the caller's name in the metadata of a call",
    )
    grpc_calls: int = Field(
        default=1000, ge=1, le=100_000, description="gRPC calls open at once; further ones are refused"
    )
    grpc_connections: int = Field(
        default=10_000,
        ge=1,
        le=1_000_000,
        description="gRPC connections open at once, fewer by the limit of open files; further ones are closed",
    )
    log_format: Literal["console", "json"] = Field(default="console", description="form of the log lines on stderr")
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        default="info", description="lowest level that is logged"
    )
    ros2: Ros2Settings = Field(default=Ros2Settings(), description="topics of ROS 2, for `optipmb-service ros2`")
    limits: LimitSettings = Field(default=LimitSettings(), description="bounds on what one message may hold")

    @property
    def is_router(self) -> bool:
        """Whether this process routes for others."""
        return not self.connect if self.router is None else self.router

    @property
    def endpoints(self) -> tuple[str, ...]:
        """Endpoints to listen on."""
        if self.listen is not None:
            return self.listen
        return (DEFAULT_LISTEN,) if self.is_router else ()

    @property
    def unprotected(self) -> tuple[str, ...]:
        """Addresses beyond this machine where everybody who reaches them may publish and command."""
        endpoints = () if self.zenoh_config else self.endpoints
        addresses = [(one, one.partition("/")[2].partition("?")[0].partition("#")[0]) for one in endpoints]
        if self.grpc_tls is None and not self.grpc_tokens and self.grpc:
            addresses.append((f"grpc {self.grpc}", self.grpc))
        hosts = [(said, address.rpartition(":")[0].strip("[]")) for said, address in addresses]
        return tuple(said for said, host in hosts if host and host != "localhost" and not _is_loopback(host))

    @property
    def folder(self) -> Path | None:
        """Where state is kept; None: nowhere."""
        if self.store == "none":
            return None
        if self.store:
            return Path(self.store).expanduser()
        # Instances on one network share the state, other networks of the same host have their own.
        where = re.sub(r"[^A-Za-z0-9_.]+", "-", f"{self.prefix} {(*self.connect, *self.endpoints)[0]}")
        return state_home() / where

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Take values given to the constructor alone: `load` reads the file and the environment in its order."""
        del settings_cls, env_settings, dotenv_settings, file_secret_settings
        return (init_settings,)
