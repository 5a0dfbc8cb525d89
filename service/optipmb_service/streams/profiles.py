"""Settings by stream name: its profile, and the session that it shares with others.

All profiles are read once, at the start, so that a bad file ends the start and not a session. Over the network only
these and the profiles that come with the tracker can be asked for, never a path.

The sensors of a node that the setting `fuse` names share a session, `site/node/fused`, and so do the streams of a site
that `fused.NAME` names, `site/fused/NAME`. Its tracks, queries, owner and checkpoint are found by that name, as if it
were a stream's.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Final

import optipmb_schemas as schemas

import optipmb
from optipmb.model.parameters import ALIKE

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from optipmb_service.settings import SensorSettings, Settings, ZoneSettings


@dataclass(frozen=True)
class Profiles:
    """The profiles in force.

    Attributes:
        default: name of the profile of streams that no pattern names, as the settings give it.
        patterns: pairs of stream pattern and profile name, the first that matches holds.
        known: all profiles by the name that the settings give, and by the name inside the file.
        sensors: settings of sensors of fused sessions.
        missing_s: returns after which time, s, objects out of view count as missed; None: as in the profile.
    """

    default: str
    patterns: tuple[tuple[str, str], ...]
    known: Mapping[str, optipmb.Parameters]
    sensors: optipmb.Sensors = ALIKE
    missing_s: Callable[[str], float | None] = lambda _: None

    @classmethod
    def read(
        cls,
        default: str,
        patterns: Mapping[str, str],
        sensors: Mapping[str, SensorSettings] | None = None,
        missing_s: Callable[[str], float | None] = lambda _: None,
    ) -> Profiles:
        """Load every profile named, and the tracker's own.

        Raises:
            optipmb.ParameterError: one of them cannot be read or is not valid.
        """
        known: dict[str, optipmb.Parameters] = {}
        for name in (default, *patterns.values(), *optipmb.profiles()):
            if name not in known:
                known[name] = _loaded(name)
        for parameters in tuple(known.values()):
            known.setdefault(parameters.name, parameters)
        tables = {pattern: one.model_dump() for pattern, one in (sensors or {}).items()}
        return cls(default, tuple(patterns.items()), known, optipmb.Sensors.read(tables), missing_s)

    def check_zones(self, zones: Mapping[str, ZoneSettings]) -> None:
        """Check the classes of zones.

        Raises:
            optipmb.ParameterError: no profile of the settings has one of them.
        """
        profiles = [self.known[name] for name in (self.default, *(name for _, name in self.patterns))]
        labels = sorted({label for one in profiles for label in one.labels})
        for name, zone in zones.items():
            for label in zone.classes:
                if label not in labels:
                    expected = f"classes of the profiles in force: {', '.join(labels)}"
                    raise optipmb.ParameterError(f"setting zones.{name}.classes", expected, repr(label))

    def of(self, stream: str) -> optipmb.Parameters:
        """Return the parameters of a stream, `site/node/sensor`."""
        found = (name for pattern, name in self.patterns if fnmatchcase(stream, pattern))
        return self._used(self.known[next(found, self.default)], stream)

    def named(self, name: str, stream: str) -> optipmb.Parameters | None:
        """Return the parameters of a stream in a profile, None when there is none of this name."""
        parameters = self.known.get(name)
        return None if parameters is None else self._used(parameters, stream)

    def _used(self, parameters: optipmb.Parameters, stream: str) -> optipmb.Parameters:
        missing_s = self.missing_s(stream)
        return parameters if missing_s is None else parameters.model_copy(update={"unseen_time": missing_s})

    def trackers(self, make: Callable[..., optipmb.Tracker]) -> Callable[..., optipmb.Tracker]:
        """Return what gives all streams of a profile one tracker, for it keeps nothing of them (0.6 ms each)."""
        made = {parameters.name: make(parameters) for parameters in self.known.values()}

        def tracker(parameters: optipmb.Parameters, **joining: optipmb.Rejoin) -> optipmb.Tracker:
            if joining:
                return make(parameters, **joining)
            found = made.get(parameters.name)
            same = found is not None and (found.parameters is parameters or found.parameters == parameters)
            return found if found is not None and same else make(parameters)

        return tracker

    @property
    def names(self) -> tuple[str, ...]:
        """The names that can be asked for."""
        return tuple(sorted({parameters.name for parameters in self.known.values()}))


def _loaded(name: str) -> optipmb.Parameters:
    try:
        parameters = optipmb.load_profile(name)
    except optipmb.ParameterError as error:
        path = error.path if error.path == "profile" else f"profile {name}: {error.path}"
        raise optipmb.ParameterError(path, error.expected, error.received) from error
    try:
        schemas.SessionParameters(profile=parameters.name)
    except schemas.MessageError as error:
        raise optipmb.ParameterError(f"profile {name}: name", error.expected, error.received) from error
    return parameters


FUSED: Final = "fused"
"""The sensor in the name of such a session, or the node."""


@dataclass(frozen=True)
class Fusion:
    """Streams that share sessions.

    Attributes:
        patterns: of streams, `site/node/sensor`, each part with `*` for any text.
        sites: patterns of the streams of several nodes, by the session that they feed, `site/fused/NAME`.
    """

    patterns: Sequence[str] = ()
    sites: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @classmethod
    def of(cls, settings: Settings) -> Fusion:
        return cls(settings.fuse, {name: one.streams for name, one in settings.fused_sessions.items()})

    def session_of(self, stream: str) -> str:
        """Return the name of the session that a stream feeds: its own, its node's, or one of its site."""
        if not (self.patterns or self.sites):
            return stream
        parts = tuple(stream.split("/"))
        for session, patterns in self.sites.items():
            if any(_matches(parts, pattern) for pattern in patterns):
                return session
        matched = any(_matches(parts, pattern) for pattern in self.patterns)
        return f"{parts[0]}/{parts[1]}/{FUSED}" if matched else stream

    def is_session(self, name: str) -> bool:
        """Return whether a name is of a fused session; no sensor may have it."""
        site, node, sensor = name.split("/")
        if self.sites and node == FUSED:
            return True
        return sensor == FUSED and any(_matches((site, node), pattern) for pattern in self.patterns)

    def sensors_of(self, name: str, sensors: optipmb.Sensors) -> optipmb.Sensors:
        """Return what settings say of the sensors that may feed a session."""
        if not (sensors.uses and self.is_session(name)):
            return ALIKE
        parts = tuple(self.feeds(name).split("/"))
        return optipmb.Sensors(tuple(one for one in sensors.uses if _matches(parts, one[0])))

    def feeds(self, name: str) -> str:
        """Return what the streams of a fused session have in common: their site or their node, `site/node`."""
        site, node, _ = name.split("/")
        return site if self.sites and node == FUSED else f"{site}/{node}"

    def seen_by(self, name: str) -> str:
        """Return the pattern of the streams whose detections belong to the tracks of a session, in Zenoh's words."""
        if not self.is_session(name):
            return name
        common = self.feeds(name)
        return f"{common}/*" if "/" in common else f"{common}/*/*"


def _matches(parts: tuple[str, ...], pattern: str) -> bool:
    return all(fnmatchcase(part, wanted) for part, wanted in zip(parts, pattern.split("/"), strict=False))
